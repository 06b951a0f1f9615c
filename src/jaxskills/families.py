# SPDX-License-Identifier: Apache-2.0
"""Training of a family of skills: one update runs, learns and takes stock (FS sections 4 to 6).

It is `trainer.update` for many task parameters at once: W of them a batch, a few environments each.
All begin anew in an update, so its whole episodes are those that the family learns from. Bodies and
physics of a batch are compiled on the host beforehand, `Trainer.world`, and are an argument.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import character as character_lib
from jaxskills import objects, recipes, trainer
from jaxskills import physics as physics_lib
from jaxskills import variation as variation_lib
from jaxskills.character import Character
from jaxskills.env import bounds as bounds_lib
from jaxskills.env import core, variants, worlds
from jaxskills.env import task as task_lib
from jaxskills.env.task import TaskSpec
from jaxskills.env.worlds import World
from jaxskills.errors import UserError
from jaxskills.explore import episodes, fitness
from jaxskills.explore import family as family_lib
from jaxskills.explore import lean as lean_lib
from jaxskills.explore import refine as refine_lib
from jaxskills.explore import starts as starts_lib
from jaxskills.explore.episodes import Record
from jaxskills.learn import networks as networks_lib
from jaxskills.learn import normalize, ppo, rollout
from jaxskills.motion import CONTROL_DT, Motion
from jaxskills.physics import Physics
from jaxskills.trainer import TrainConfig, Trainer, TrainState

# A performance may take so many times as long as the reference.
_SLOWEST = 2.5
# What a task parameter and the log of the speed are normalised by: they hardly vary at first.
_PARAMETER = 0.5, 0.3
_SPEED = 0.0, 0.3


def make(config: TrainConfig, spec: TaskSpec | None = None) -> Trainer:
    """Returns the trainer of a configuration, of one skill or of a family.

    Args:
      config: all settings; its `task` names the recipe of the task.
      spec: the task itself, where there is no recipe.

    Raises:
      UserError: a value out of range, an unknown name, a broken clip, character or task.
    """
    spec = recipes.task(config.task) if spec is None and config.task else spec
    if spec is None:
        return trainer.make(config)
    if spec.free:
        return _family(config, spec)
    character = character_lib.load(config.character)
    return trainer.make(config, task_lib.scenery(spec, character), spec.objects)


class Parts(NamedTuple):
    """What all updates of a family share."""

    config: TrainConfig
    character: Character
    shown: Motion  # the reference m_0
    task: task_lib.Task
    engine: Physics
    bounds: bounds_lib.Bounds
    judge: fitness.Judge
    knots: int  # K of a variation


def parts(config: TrainConfig, spec: TaskSpec) -> Parts:
    """Returns the parts of a configuration, on the host.

    Raises:
      UserError: as `make`.
    """
    validate(config)
    character = task_lib.placed(spec, character_lib.load(config.character))
    character, shown = objects.add(character, trainer.reference(config, character), spec.objects)
    task = task_lib.make(spec, character, shown)
    itself = task_lib.variant(spec, character, task.base)
    return Parts(
        config,
        character,
        shown,
        task,
        physics_lib.make(trainer.backend(config), 1, num_envs=config.envs),
        bounds_lib.make(character, config.bounds),
        fitness.make(itself, shown, config.family.fitness),
        variation_lib.knot_count(config.family.variation, shown),
    )


def environment(own: Parts, world: World, asked: family_lib.Asked) -> core.Environment:
    """Returns the environment of a batch of task parameters. Its arrays may be traced."""
    layout, length = own.character.layout, float(own.shown.length)
    made, fed = (variation_lib.unflatten(x, layout.own.nv) for x in (asked.x, asked.fed))
    displace = jax.jit(jax.vmap(functools.partial(variation_lib.displace, layout)))
    motions = displace(world.motion, made)  # on the host too, and at once
    ahead = variants.Fed(displace(world.motion, fed), fed)
    first = world.motion.qpos[:, 0], world.motion.qvel[:, 0]
    rows = variants.Variant(
        motions, made, world.body, world.shapes, asked.a, world.holds, ahead, first
    )
    both = variants.Variants(rows, world.model, asked.a.shape[0], length, own.shown.loop)
    config = env_config(own.config, own.shown)
    return core.make(own.character, both, own.engine, own.bounds, config, task=own.task)


def _family(config: TrainConfig, spec: TaskSpec) -> Trainer:
    own = parts(config, spec)
    reference = jnp.asarray(own.task.base, jnp.float32)
    size = own.knots * (own.character.layout.own.nv + 1)  # an object's path is not varied
    compiled = worlds.make(
        own.character, own.shown, spec, own.engine, CONTROL_DT / config.env.substeps
    )
    world = lambda state: compiled(np.asarray(state.family.asked.a))  # noqa: E731
    first = family_lib.first(config.family, reference, size)
    plain = environment(own, compiled(np.asarray(first.a)), first)
    obs_size = jax.eval_shape(lambda: plain.observe(plain.start(jnp.float32(0.0)))).shape[0]
    nets = networks_lib.make(config.networks, obs_size, plain.action_size, config.ppo.discount)

    def init(key: jax.Array) -> TrainState:
        learner_key, family_key, key = jax.random.split(key, 3)
        return TrainState(
            ppo.init(config.ppo, nets, learner_key),
            pinned(own, normalize.init(obs_size)),
            starts_lib.init(config.starts),
            None,
            None,
            key,
            jnp.int32(0),
            jnp.uint32(0),
            refine_lib.init(),
            family=family_lib.init(config.family, reference, size, family_key),
        )

    def update(state: TrainState, at: World) -> tuple[TrainState, dict[str, jax.Array]]:
        practice_key, stock_key = jax.random.split(jax.random.fold_in(state.key, state.updates))
        state, practice, metrics = practise(own, nets, state, at, practice_key)
        state, seen = take_stock(own, state, at, practice, stock_key)
        counts = state.updates + 1, state.samples + jnp.uint32(samples)
        return dataclasses.replace(state, updates=counts[0], samples=counts[1]), metrics | seen

    samples = config.envs * config.horizon * chunk_count(config, own.shown)
    return Trainer(
        config, own.character, own.shown, plain, nets, init, update, samples, world, spec
    )


@struct.dataclass
class Practice:
    """What happened in an update, T steps of B environments."""

    record: Record  # [T, B]
    value: jax.Array  # [T, B] before each step, in units of the largest return
    reward: jax.Array  # [] mean


def practise(
    own: Parts, nets: networks_lib.Networks, state: TrainState, world: World, key: jax.Array
) -> tuple[TrainState, Practice, dict[str, jax.Array]]:
    """Returns the state after some updates of policy and value function, and what happened.

    The key is consumed.
    """
    config, family = own.config, state.family
    assert family is not None
    env, base = environment(own, world, family.asked), ~family.base.learnt
    begin_key, key = jax.random.split(key)

    def chunk(carry, key: jax.Array):
        learner, normalizer, current = carry
        start_key, act_key, learn_key = jax.random.split(key, 3)
        fresh = _begin(own, env, base, start_key)
        now = learner.policy, normalizer, current, fresh, act_key
        current, steps = rollout.collect(env, nets, *now, config.horizon, mixed=False)
        # The reference is learnt without its task, so that episodes may begin anywhere.
        steps = dataclasses.replace(steps, spike=jnp.where(base, 0.0, steps.spike))
        batch = trainer.to_batch(config.ppo, nets, learner, normalizer, steps)
        value = nets.value(learner.value, batch.obs).reshape(steps.phase.shape)
        learner, watched = ppo.update(config.ppo, nets, learner, batch, learn_key)
        seen = normalize.update(normalizer, steps.obs.reshape(-1, steps.obs.shape[-1]))
        watched |= trainer.episode_metrics(env, steps)
        return (learner, pinned(own, seen), current), (_record(env, steps), value, watched)

    carry = state.learner, state.normalizer, _begin(own, env, base, begin_key)
    keys = jax.random.split(key, chunk_count(config, own.shown))
    (learner, normalizer, _), (record, value, watched) = jax.lax.scan(chunk, carry, keys)
    record, value = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (record, value))
    sums = ("steps", "failures", "diverged", "endings")
    metrics = {k: jnp.sum(v, 0) if k in sums else jnp.mean(v, 0) for k, v in watched.items()}
    state = dataclasses.replace(state, learner=learner, normalizer=normalizer)
    return state, Practice(record, value / nets.value_scale, metrics["reward"]), metrics


def take_stock(
    own: Parts, state: TrainState, world: World, practice: Practice, key: jax.Array
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Returns the state with its family after what happened, and what to watch.

    The key is consumed.
    """
    config, family, record = own.config, state.family, practice.record
    assert family is not None
    slot, steps = slots(config), record.phase.shape[0]
    found = episodes.finished(
        own.character.layout.own,
        world.motion,
        (world.body, world.shapes),
        own.task,
        own.judge,
        record,
        family.asked.a,
        slot,
        own.knots,
        longest(config, own.shown),
        episodes.room(steps, config.envs, round(float(own.shown.length) / 2)),
    )
    results = _results(family.asked.a[slot], practice, found)
    stock_key, lean_key = jax.random.split(key)
    family, seen = family_lib.update(config.family, family, results, stock_key)
    asked = family.asked
    x = lean_lib.lean(config.family.lean, asked.x, own.character.layout.own.nv, lean_key)
    asked = dataclasses.replace(asked, x=x, fed=asked.fed + x - asked.x)
    return dataclasses.replace(state, family=dataclasses.replace(family, asked=asked)), seen


def _begin(own: Parts, env: core.Environment, base: jax.Array, key: jax.Array) -> rollout.Fresh:
    """Returns a start for each environment, most of them at phase 0. The key is consumed.

    Later ones lie where the task is not yet or no longer measured.
    """
    config, task = own.config, own.task
    late_key, place_key = jax.random.split(key)
    share = jax.random.uniform(place_key, (config.envs,))
    allowed = share * (task.begin + 1.0 - task.end)
    allowed = jnp.where(allowed < task.begin, allowed, allowed - task.begin + task.end)
    rate = jnp.where(base, config.family.base_late, config.family.late)
    rate = jnp.where(base | (task.begin + 1.0 - task.end > 0.0), rate, 0.0)
    late = jax.random.bernoulli(late_key, rate, (config.envs,))
    place = jnp.where(late, jnp.where(base, share, allowed), 0.0)
    return rollout.begin(env, place * env.length, slots(config))


def _record(env: core.Environment, steps: rollout.Transition) -> Record:
    finished = steps.truncated & (steps.phase + steps.dphase >= env.end)
    sim = steps.state.sim
    return Record(
        sim.qpos,
        sim.qvel,
        steps.phase,
        steps.dphase,
        steps.state.step,
        steps.state.known,
        finished,
    )


def _results(a: jax.Array, practice: Practice, found: episodes.Found) -> family_lib.Results:
    """Returns what an update came to; `a [B, P]` was asked for."""
    record = practice.record
    steps = record.phase.shape[0]
    first = (record.step == 0) & (record.phase < 0.5)
    # Who began too late to get through in this update counts neither way.
    left = steps - jnp.arange(steps)[:, None]
    enough = first & (left > jnp.max(jnp.where(record.finished, record.step, 0)))
    done = jnp.sum(episodes.whole(record))  # whether they keep a strict constraint or not
    success = jnp.minimum(done / jnp.maximum(jnp.sum(enough), 1), 1.0)
    many = jnp.broadcast_to(a, (*record.phase.shape, a.shape[-1])).reshape(-1, a.shape[-1])
    begun = jnp.sum(record.step == 0)
    return family_lib.Results(
        found.episodes,
        found.variant,
        many,
        practice.value.reshape(-1),
        begun,
        success,
        practice.reward,
    )


def slots(config: TrainConfig) -> jax.Array:
    """Returns which task parameter each environment has, `[B]` int32."""
    return jnp.arange(config.envs, dtype=jnp.int32) % config.family.curriculum.batch


def env_config(config: TrainConfig, shown: Motion) -> core.EnvConfig:
    """Returns what an episode of a family is: one performance of the motion."""
    seconds = longest(config, shown) * CONTROL_DT
    return dataclasses.replace(config.env, once=True, seconds=seconds)


def longest(config: TrainConfig, shown: Motion) -> int:
    """Returns how many control steps an episode has at most."""
    slow = _SLOWEST if config.env.time_warp else 1.0
    return math.ceil(slow * float(shown.length) + config.env.hold) + 1


def chunk_count(config: TrainConfig, shown: Motion) -> int:
    """Returns how many times policy and value function are updated in one update of a family."""
    steps = config.family.episodes * (float(shown.length) + config.env.hold)
    return math.ceil(steps / config.horizon)


def pinned(own: Parts, normalizer: normalize.Normalizer) -> normalize.Normalizer:
    """Returns the statistics with those of the task parameters and of the speed of phase set."""
    rows = [_SPEED] * own.config.env.time_warp + [_PARAMETER] * len(own.task.base)
    mean, deviation = jnp.array(rows).reshape(-1, 2).T
    place = normalizer.mean.shape[0] - own.task.reference.shape[0] - len(rows)
    return normalize.pin(normalizer, place, mean, deviation)


def validate(config: TrainConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    trainer.validate(config)
    family_lib.validate(config.family)
    if config.env.reward != "tracking":
        raise UserError(f"env.reward is {config.env.reward}: a family needs tracking")
    batch = config.family.curriculum.batch
    if config.envs % batch:
        raise UserError(
            f"envs is {config.envs}: give a multiple of {batch} (family.curriculum.batch)"
        )
