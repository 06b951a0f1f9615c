# SPDX-License-Identifier: Apache-2.0
"""Training as one pure function over one state: `update(state) -> (state, metrics)`.

`TrainState` holds everything needed to continue bit for bit; `save` and `restore` are in
`checkpoint.py`, the loop that a person starts is in `train.py`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from jaxskills import character as character_lib
from jaxskills import clip as clip_lib
from jaxskills import flight, levels, objects, pose, retarget
from jaxskills import motion as motion_lib
from jaxskills import physics as physics_lib
from jaxskills.character import Character, Object
from jaxskills.env import bounds as bounds_lib
from jaxskills.env import core, gram, variants
from jaxskills.env.task import TaskSpec
from jaxskills.errors import UserError
from jaxskills.explore import adaptive as adaptive_lib
from jaxskills.explore import evolution as evolution_lib
from jaxskills.explore import family as family_lib
from jaxskills.explore import refine as refine_lib
from jaxskills.explore import starts as starts_lib
from jaxskills.learn import autoencoder, gae, normalize, rollout
from jaxskills.learn import networks as networks_lib
from jaxskills.learn import ppo as ppo_lib
from jaxskills.motion import CONTROL_DT, Motion

PHASE_BINS = 20  # of the count of what ended episodes where


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run, besides the machine."""

    clip: str = "walk"
    task: str = ""  # the recipe, or its file, that says what a family varies in; none: one skill
    character: str = "humanoid34"
    backend: Literal["auto", "cpu", "mjx", "warp"] = "auto"
    seed: int = 0
    init_from: str | None = None  # a run whose networks it begins with; None: untrained ones
    samples: int = 10_000_000  # at most; training stops before when the skill is learnt
    envs: int = 128
    stop_when_learnt: bool = True  # 20 s without a fall, at 600 Hz physics too; see judge.py
    horizon: int = 16  # control steps of each environment in an update
    env: core.EnvConfig = core.EnvConfig()
    bounds: bounds_lib.BoundsConfig = dataclasses.field(default_factory=bounds_lib.BoundsConfig)
    adaptive_bounds: adaptive_lib.AdaptiveBoundsConfig = adaptive_lib.AdaptiveBoundsConfig()
    motion: motion_lib.MotionConfig = motion_lib.MotionConfig()
    starts: starts_lib.StartsConfig = starts_lib.StartsConfig()
    evolution: evolution_lib.EvolutionConfig = evolution_lib.EvolutionConfig()
    refine: refine_lib.RefineConfig = refine_lib.RefineConfig()
    family: family_lib.FamilyConfig = family_lib.FamilyConfig()
    networks: networks_lib.NetworkConfig = networks_lib.NetworkConfig()
    ppo: ppo_lib.PPOConfig = ppo_lib.PPOConfig()


# What ends an episode of a family besides a fall. A motion that is new may be far from all that are
# known, so bounds as tight as SB's keep a family from growing. The authors' code has 0.4 pi for the
# root too, without which a family of turns grows faster still.
FAMILY_BOUNDS = bounds_lib.BoundsConfig((0.8, 0.8, 0.8), math.inf, math.inf, math.inf)


def for_family(config: TrainConfig = TrainConfig()) -> TrainConfig:
    """Returns a configuration with what FS sets otherwise than SB, for the recipe of a family.

    Rewards of FS 4.2, time warp of 4.1, the discount of 7; the noise of exploration is that of the
    authors' code, since with SB's a family does not find what lies beyond its region. These, that a
    fall ends an episode, and the number of environments are set whatever `config` has; bounds are
    wide unless it has its own; the rest of it stays.
    """
    env = dataclasses.replace(config.env, reward="tracking", time_warp=True, stop="either")
    networks = dataclasses.replace(config.networks, noise=0.1)
    ppo = dataclasses.replace(config.ppo, discount=0.95)
    bounds = FAMILY_BOUNDS if config.bounds == bounds_lib.BoundsConfig() else config.bounds
    changes = dataclasses.replace(config, env=env, networks=networks, ppo=ppo, bounds=bounds)
    return dataclasses.replace(changes, envs=160)


@struct.dataclass
class TrainState:
    """One training run between two updates."""

    learner: ppo_lib.Learner
    normalizer: normalize.Normalizer
    starts: starts_lib.Starts
    elites: evolution_lib.Elites | None  # None: episodes begin on the reference
    current: rollout.Fresh | None  # the B environments and what they show; None: all begin anew
    key: jax.Array  # root of all randomness; the number of updates is folded in
    updates: jax.Array  # [] int32
    samples: jax.Array  # [] uint32, transitions learnt from
    refinement: refine_lib.Refinement  # where it is fine, `refined` says how the next update goes
    adaptive: adaptive_lib.Adaptive | None = None  # None: the bounds stay as they are
    family: family_lib.Family | None = None  # None: one skill


class Trainer(NamedTuple):
    """A run's parts. `init` and `update` are pure: jit them, scan them."""

    config: TrainConfig
    character: Character
    motion: Motion
    env: core.Environment
    networks: networks_lib.Networks
    init: Callable[[jax.Array], TrainState]  # (key) -> state
    # (state) -> state, metrics; of a family (state, world) -> state, metrics
    update: Callable[..., tuple[TrainState, dict[str, jax.Array]]]
    samples: int  # transitions of an update
    # On the host, before each update: (state) -> the bodies and physics that it asks for.
    world: Callable[[TrainState], Any] | None = None
    task: TaskSpec | None = None  # what a family varies in; None: one skill


def reference(config: TrainConfig, character: Character) -> Motion:
    """Returns the clip of a configuration as a motion of the character, where it stands."""
    clip = clip_lib.load(config.clip)
    clip = clip if config.motion.loop else clip_lib.once(clip)
    clip = clip_lib.cut(clip, config.motion.start, config.motion.end)
    qpos = retarget.retarget(character, clip)
    made = motion_lib.from_qpos(character.model, qpos, clip.times, clip.loop, config.motion)
    made = flight.ballistic(character, made) if config.motion.ballistic else made
    return levels.raised(character, made)


def backend(config: TrainConfig) -> str:
    """Returns the physics backend of a configuration."""
    return physics_lib.default_backend() if config.backend == "auto" else config.backend


def environment(
    config: TrainConfig, character: Character, motion: Motion, envs: int
) -> core.Environment:
    """Returns the environment of a configuration, made for batches of `envs`."""
    core.validate(config.env)
    engine = physics_lib.make(backend(config), 1, num_envs=envs)
    timestep = CONTROL_DT / config.env.substeps
    model = engine.load([character_lib.compile(character, timestep)])
    bounds = bounds_lib.make(character, config.bounds)
    clip = config.env.style.style_clip
    wanted = None if clip is None else style(config, character, motion, clip)
    only = variants.one(character, motion, model)
    return core.make(character, only, engine, bounds, config.env, wanted)


def style(config: TrainConfig, character: Character, motion: Motion, clip: str) -> gram.Style:
    """Returns the style of a clip, for a character that follows `motion`.

    How fast the root moves is no part of it: the reference and its bounds settle that.

    Raises:
      UserError: a broken clip, or an autoencoder that is missing or of other bodies.
    """
    wanted = config.env.style
    clip_lib.find(clip)  # a mistake in its name is said first
    model = autoencoder.load(wanted.autoencoder or autoencoder.shipped(), character)
    shown = reference(dataclasses.replace(config, clip=clip), character)
    encode = functools.partial(autoencoder.style, model)
    return gram.make(character, motion, shown, encode, model.width, wanted.look_back)


def make(
    config: TrainConfig,
    scenery: Sequence[Callable[[mujoco.MjSpec], None]] = (),
    things: Sequence[Object] = (),
) -> Trainer:
    """Returns the trainer of a configuration.

    Args:
      config: all settings.
      scenery: puts what stands around the character into the spec.
      things: move beside it.

    Raises:
      UserError: a value out of range, an unknown name, a broken clip or character.
    """
    validate(config)
    character = character_lib.placed(character_lib.load(config.character), scenery)
    character, motion = objects.add(character, reference(config, character), things)
    env = environment(config, character, motion, config.envs)
    obs_size = jax.eval_shape(lambda: env.observe(env.start(jnp.float32(0.0)))).shape[0]
    nets = networks_lib.make(config.networks, obs_size, env.action_size, config.ppo.discount)

    layout = character.layout

    def begin(
        starts: starts_lib.Starts, elites: evolution_lib.Elites | None, key: jax.Array
    ) -> rollout.Fresh:
        if elites is None:
            phase = starts_lib.sample(config.starts, starts, key, config.envs, env.length)
            return rollout.begin(env, phase)
        segment_key, elite_key = jax.random.split(key)
        segment = starts_lib.sample_segments(config.starts, starts, segment_key, config.envs)
        return rollout.begin_at(
            env, *evolution_lib.draw(config.evolution, layout, elites, elite_key, segment)
        )

    def init(key: jax.Array) -> TrainState:
        learner_key, start_key, key = jax.random.split(key, 3)
        starts, elites = starts_lib.init(config.starts), None
        if config.evolution.enabled:
            elites = evolution_lib.init(config.evolution, layout, motion, config.starts.segments)
        adaptive = None
        if config.adaptive_bounds.enabled:
            adaptive = adaptive_lib.init(config.adaptive_bounds)
        current = adaptive_lib.under(adaptive, begin(starts, elites, start_key))
        normalizer = normalize.update(normalize.init(obs_size), current.obs)
        learner = ppo_lib.init(config.ppo, nets, learner_key)
        counts = jnp.int32(0), jnp.uint32(0)
        more = refine_lib.init(), adaptive
        return TrainState(learner, normalizer, starts, elites, current, key, *counts, *more)

    def update(state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        assert state.current is not None
        key = jax.random.fold_in(state.key, state.updates)
        start_key, act_key, learn_key, evolve_key = jax.random.split(key, 4)
        current, steps = rollout.collect(
            env,
            nets,
            state.learner.policy,
            state.normalizer,
            adaptive_lib.under(state.adaptive, state.current),
            adaptive_lib.under(state.adaptive, begin(state.starts, state.elites, start_key)),
            act_key,
            config.horizon,
            CONTROL_DT / config.starts.renewal,
        )
        batch = to_batch(config.ppo, nets, state.learner, state.normalizer, steps)
        learner, metrics = ppo_lib.update(config.ppo, nets, state.learner, batch, learn_key)
        flat_obs = steps.obs.reshape(-1, obs_size)
        starts = starts_lib.update(
            config.starts,
            state.starts,
            within_cycle(env, steps.phase).reshape(-1),
            batch.target,
            (steps.state.step == 0).reshape(-1),
            env.length,
        )
        elites = state.elites
        if elites is not None:
            visited = visited_states(layout, motion, steps, batch.target)
            elites = evolution_lib.update(
                config.evolution, elites, visited, evolve_key, motion.length
            )
        metrics |= episode_metrics(env, steps)
        failures, seconds = metrics["failures"], config.envs * config.horizon * CONTROL_DT
        refinement = refine_lib.update(config.refine, state.refinement, failures, seconds)
        metrics["fine"] = refinement.fine
        adaptive = state.adaptive
        if adaptive is not None:
            metrics["bound_scale"] = adaptive.scale
            adaptive = adaptive_lib.update(config.adaptive_bounds, adaptive, failures, seconds)
        new_state = TrainState(
            learner,
            normalize.update(state.normalizer, flat_obs),
            starts,
            elites,
            current,
            state.key,
            state.updates + 1,
            state.samples + jnp.uint32(config.envs * config.horizon),
            refinement,
            adaptive,
        )
        return new_state, metrics

    samples = config.envs * config.horizon
    return Trainer(config, character, motion, env, nets, init, update, samples)


def refined(made: Trainer) -> Trainer:
    """Returns the same trainer with finer physics steps, for states whose refinement is fine.

    Its `update` is another program, which takes and gives the same kind of state.
    """
    finer = dataclasses.replace(made.config.env, substeps=fine_substeps(made.config))
    scene = made.character.scenery, made.character.objects
    return make(dataclasses.replace(made.config, env=finer), *scene)


def fine_substeps(config: TrainConfig) -> int:
    """Returns the physics steps of a control step for states whose refinement is fine."""
    return config.env.substeps * config.refine.factor


def as_fine(made: Trainer, state: TrainState) -> Trainer:
    """Returns the trainer with physics steps as fine as those that the state was learnt with."""
    return refined(made) if bool(state.refinement.fine) else made


def to_batch(
    config: ppo_lib.PPOConfig,
    nets: networks_lib.Networks,
    learner: ppo_lib.Learner,
    normalizer: normalize.Normalizer,
    steps: rollout.Transition,
) -> ppo_lib.Batch:
    """Returns the transitions `[T, B]` as one batch `[T B]` with advantages and value targets."""
    obs = normalize.apply(normalizer, steps.obs)
    value = nets.value(learner.value, obs)
    next_value = nets.value(learner.value, normalize.apply(normalizer, steps.next_obs))
    ended = steps.terminated | steps.truncated
    along_time = jax.vmap(gae.advantages, in_axes=(1,) * 7 + (None, None), out_axes=1)
    advantage = along_time(
        steps.rate,
        steps.spike,
        steps.dphase,
        value,
        next_value,
        steps.terminated,
        ended,
        config.discount,
        config.lambda_,
    )
    deviation = jnp.maximum(jnp.std(advantage), 1e-6)
    scaled = (advantage - jnp.mean(advantage)) / deviation
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    return jax.tree.map(
        flat, ppo_lib.Batch(obs, steps.action, steps.log_prob, scaled, advantage + value)
    )


def visited_states(
    layout: pose.Layout, motion: Motion, steps: rollout.Transition, value: jax.Array
) -> evolution_lib.Visited:
    """Returns the states of transitions `[T, B]` in the first cycle, and their `value [T B]`."""
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    folded = jax.vmap(lambda q, v, phase: motion_lib.fold(layout, motion, q, v, phase))(
        flat(steps.state.sim.qpos), flat(steps.state.sim.qvel), flat(steps.phase)
    )
    return evolution_lib.Visited(*folded, value)


def within_cycle(env: core.Environment, phase: jax.Array) -> jax.Array:
    """Returns phases moved into [0, length), or held there if the motion does not loop."""
    last = env.length * (1.0 - 1e-6)
    return phase % env.length if math.isinf(env.end) else jnp.minimum(phase, last)


def episode_metrics(env: core.Environment, steps: rollout.Transition) -> dict[str, jax.Array]:
    """Returns counts of an update, to be summed over updates by whoever shows them.

    `steps` and `failures` give the mean time to a failure; `endings [E, PHASE_BINS]` says what
    they were and at which phase. An episode that was cut off is none.
    """
    ended = steps.terminated
    place = jnp.floor(within_cycle(env, steps.phase) / env.length * PHASE_BINS).astype(jnp.int32)
    by_cause = jax.nn.one_hot(steps.ended_by, len(env.endings)) * ended[..., None]
    by_phase = jax.nn.one_hot(jnp.clip(place, 0, PHASE_BINS - 1), PHASE_BINS)
    return {
        "steps": jnp.float32(ended.size),
        "failures": jnp.sum(ended, dtype=jnp.float32),
        "diverged": jnp.sum(by_cause[..., env.endings.index("diverged")]),
        "endings": jnp.einsum("tbe,tbp->ep", by_cause, by_phase),
        "reward": jnp.mean(steps.spike + steps.rate),
    }


def validate(config: TrainConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    for name in ("envs", "horizon", "samples"):
        if getattr(config, name) < 1:
            raise UserError(f"{name} is {getattr(config, name)}: give 1 or more")
    if not 0 <= config.seed < 2**32:
        raise UserError(f"seed is {config.seed}: give 0 to {2**32 - 1}")
    core.validate(config.env)
    starts_lib.validate(config.starts)
    evolution_lib.validate(config.evolution)
    adaptive_lib.validate(config.adaptive_bounds)
    refine_lib.validate(config.refine)
    if config.adaptive_bounds.enabled and config.env.stop == "fall":
        raise UserError(
            f"env.stop is {config.env.stop}: adaptive_bounds need bounds, which end the episodes"
        )
    ppo_lib.validate(config.ppo, config.envs * config.horizon)
