# SPDX-License-Identifier: Apache-2.0
"""The environment: a character that follows a reference, one environment per call.

`reset` and `step` are pure functions of one environment; the rollout vmaps them, in one place. The
action is a displacement of the servo targets from the reference (SB fig. 4, FS eq. 4).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import ground, kinematics, objects, pose
from jaxskills import variation as variation_lib
from jaxskills.character import Character
from jaxskills.env import bounds as bounds_lib
from jaxskills.env import gram, holds, observe, rewards
from jaxskills.env import style as style_lib
from jaxskills.env import tracking as tracking_lib
from jaxskills.env.measure import Moment
from jaxskills.env.task import Task
from jaxskills.env.variants import Fed, Variant, Variants, begin, pick
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies
from jaxskills.motion import CONTROL_DT, sample
from jaxskills.physics import Physics, SimState, servo

# How an episode may end besides leaving a named bound.
OTHER_ENDINGS = ("ground contact", "fall", "diverged", "time limit")

_LIFT_MARGIN = 1e-3  # m, a start is lifted this far out of the floor


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What an episode is."""

    substeps: int = 4  # physics steps in a control step of 1/30 s: 120 Hz
    seconds: float = 20.0  # longest episode, SB Table 1
    hold: float = 15.0  # control frames for which the last pose of a motion without loop is held
    lead: float = 1.0  # control frames the feed-forward target is ahead of the state, FS eq. 4
    # The servos damp towards the reference's speed, not towards rest: otherwise they lag by kd/kp,
    # 0.1 s for DeepMimic's gains, and a run leaves its bounds within 0.1 s by its knees alone.
    velocity_feedforward: bool = True
    feedforward: bool = True  # off: displacements are from the zero pose, not from the reference
    # What a step inside the bounds earns: 1, DeepMimic's imitation, a style (SB eq. 8), both
    # weighted (SB eq. 13, for comparison), or tracking and a task (FS eq. 5).
    reward: Literal["survival", "imitation", "style", "blend", "tracking"] = "survival"
    tracking: tracking_lib.TrackingConfig = tracking_lib.TrackingConfig()
    # The policy chooses how fast phase goes by too, FS eq. 3 and 4: the log of the speed is that of
    # the reference and so many times its action. Scale and limits are those of the authors' code.
    time_warp: bool = False
    warp_scale: float = 1.5
    warp_limits: tuple[float, float] = (-2.0, 1.0)
    style: style_lib.StyleConfig = style_lib.StyleConfig()
    style_weight: float = 0.5  # of the style in a blend, w_s of SB eq. 13
    stop: Literal["bounds", "fall", "either"] = "bounds"  # ends an episode; DeepMimic: fall
    torque_limits: bool = True  # off: servos of any strength, FS section 7.4
    once: bool = False  # an episode is over soon after the first cycle of a motion that loops
    may_touch: tuple[str, ...] | None = None  # the ground: bodies, or `*_knee`; None: the feet
    heading: Literal["forward", "lateral"] = "forward"  # lateral for backflips and rolls, SB 4.1


@struct.dataclass
class EnvState:
    """One environment between control steps."""

    sim: SimState
    phase: jax.Array  # [] control frames since the start of the reference's first cycle
    step: jax.Array  # [] int32, control steps since the episode began
    variant: jax.Array  # [] int32, which of the `Variants` it is
    scale: jax.Array | None = None  # [] that multiplies the sizes of the bounds; None: 1
    window: gram.Window | None = None  # the motion up to now, if the style is gram
    known: jax.Array | None = None  # [M, 2] what is known of the task's measures, if there is one


@struct.dataclass
class Report:
    """What one step looked like, for people and plots; nothing is computed from it."""

    errors: jax.Array  # [K] m or rad
    sizes: jax.Array  # [K] of the bounds
    inside: jax.Array  # [] bool
    fallen: jax.Array  # [] bool
    ended_by: jax.Array  # [] int32 into `Environment.endings`, meaningful when an episode ended
    com: jax.Array  # [3] m
    torque: jax.Array  # [nu] N m, applied at the end of the step


@struct.dataclass
class Outcome:
    """What a step gives to learning."""

    obs: jax.Array  # [O] after the step
    rate: jax.Array  # [] reward per control frame of phase, received continuously
    spike: jax.Array  # [] reward received at once
    dphase: jax.Array  # [] control frames of phase that went by
    terminated: jax.Array  # [] bool, the future is worth nothing
    truncated: jax.Array  # [] bool, cut off: the future goes on unseen
    report: Report


class Environment(NamedTuple):
    """Pure functions of one environment, and their sizes."""

    # (phase [], variant [] = 0) -> a state on the reference there
    start: Callable[..., EnvState]
    # (phase [], qpos [nq], qvel [nv], variant [] = 0) -> that state
    place: Callable[..., EnvState]
    observe: Callable[[EnvState], jax.Array]  # (state) -> obs [O]
    step: Callable[[EnvState, jax.Array], tuple[EnvState, Outcome]]  # (state, action [A])
    action_size: int
    endings: tuple[str, ...]  # the K bounds, then `OTHER_ENDINGS`
    length: float  # control frames in a cycle of the reference
    end: float  # control frames of phase at which an episode is cut off, inf if the motion loops


class _Seen(NamedTuple):
    """What both the observation and the bounds need of a state."""

    bodies: Bodies
    reference: Bodies
    offset: jax.Array
    velocity_error: jax.Array
    effectors: tuple[jax.Array, jax.Array]
    whole: jax.Array  # the offset with that of objects


def make(
    character: Character,
    variants: Variants,
    physics: Physics,
    bounds: bounds_lib.Bounds,
    config: EnvConfig,
    wanted: gram.Style | None = None,
    task: Task | None = None,
) -> Environment:
    """Returns the environment of a character that follows a reference.

    Args:
      character: who.
      variants: the references, and what else environments differ by. The arrays may be traced.
      physics: the engine's functions; a step of them is one physics step.
      bounds: sizes of the spacetime bounds.
      config: what an episode is.
      wanted: the style, if it is gram.
      task: what is asked for besides the motion, if anything.
    """
    validate(config)
    if (wanted is None) == (config.style.style == "gram"):
        raise UserError(f"env.style.style is {config.style.style}: only gram comes with a style")
    layout, tree = character.layout, kinematics.tree(character.model)
    servos, weights = servo.of(character), rewards.imitation_weights(character)
    servos = servos if config.torque_limits else servo.unlimited(servos)
    effectors = tuple(character.body(name) for name in character.end_effectors)
    forward = character.forward / np.linalg.norm(character.forward)
    lateral = np.cross([0.0, 0.0, 1.0], forward)
    axis = jnp.asarray(forward if config.heading == "forward" else lateral, jnp.float32)
    grounded = character.ground if config.may_touch is None else config.may_touch
    allowed = character.bodies(grounded)
    no_touch = np.array([i for i in range(len(character.body_names)) if i not in allowed], int)
    forbidden = np.array(bounds.forbidden, int)
    dofs = np.array(servos.dofs)
    neutral = jnp.asarray(character.model.qpos0, jnp.float32)
    max_steps = round(config.seconds / CONTROL_DT)
    length, loop = variants.length, variants.loop
    scene = objects.scene(character, length)
    mine = lambda x: x if scene is None else x[: layout.own.nv]  # noqa: E731  no objects
    over = math.inf if loop and not config.once else length  # from there on a pose is held
    end = over + config.hold
    endings = (*bounds.names, *OTHER_ENDINGS)

    def look(state: EnvState) -> _Seen:
        own, qpos, qvel = pick(variants, state.variant), state.sim.qpos, state.sim.qvel
        ref_qpos, ref_qvel = sample(layout, own.motion, state.phase)
        # Simulation and reference in one batch: half the code to compile.
        both = jnp.stack((qpos, ref_qpos)), jnp.stack((qvel, ref_qvel))
        pair = jax.vmap(lambda q, v: kinematics.kinematics(tree, own.body, q, v))(*both)
        bodies, reference = (jax.tree.map(lambda x: x[i], pair) for i in range(2))  # noqa: B023
        both = [bounds_lib.heading_effectors(b, effectors, axis) for b in (bodies, reference)]
        whole, error = pose.minus(layout, ref_qpos, qpos), ref_qvel - qvel
        return _Seen(bodies, reference, mine(whole), mine(error), (both[0], both[1]), whole)

    def pace(state: EnvState, made: Variant | Fed) -> jax.Array:
        speed = variation_lib.rate(made.motion, made.variation, state.phase)
        return jnp.where(state.phase < over, speed, 1.0)

    def features(state: EnvState, seen: _Seen) -> jax.Array:
        parts = [_features(state, seen)]
        if scene is not None:
            sim = state.sim
            parts.append(scene.observe(sim.qpos, sim.qvel, seen.whole, seen.bodies, axis))
        if config.time_warp:
            parts.append(jnp.log(pace(state, pick(variants, state.variant)))[None])
        if task is not None and state.known is not None:
            parts.append(task.observe(state.known, pick(variants, state.variant).task))
        return jnp.concatenate(parts)

    def _features(state: EnvState, seen: _Seen) -> jax.Array:
        return observe.features(
            seen.bodies,
            seen.reference,
            seen.offset,
            state.phase,
            jnp.float32(length),
            axis,
            seen.effectors[0],
        )

    def start(phase: jax.Array, variant: jax.Array | int = 0) -> EnvState:
        variant = jnp.asarray(variant, jnp.int32)
        return place(phase, *begin(layout, pick(variants, variant), phase), variant)

    def place(
        phase: jax.Array, qpos: jax.Array, qvel: jax.Array, variant: jax.Array | int = 0
    ) -> EnvState:
        variant = jnp.asarray(variant, jnp.int32)
        own = pick(variants, variant)
        bodies = kinematics.kinematics(tree, own.body, qpos, qvel)
        lowest = jnp.min(ground.clearance(own.shapes, bodies, inside=True))
        qpos = qpos.at[2].add(jnp.maximum(_LIFT_MARGIN - lowest, 0.0))
        sim = physics.init(variants.model, variant, qpos, qvel)
        window = None if wanted is None else gram.fill(wanted, phase)
        known = None if task is None else task.start()
        return EnvState(sim, phase, jnp.int32(0), variant, window=window, known=known)

    def observe_state(state: EnvState) -> jax.Array:
        return features(state, look(state))

    def speeds(state: EnvState, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns how much phase the step takes, and how much the reference would."""
        if not config.time_warp:
            return jnp.float32(1.0), jnp.float32(1.0)
        own = pick(variants, state.variant)
        chosen = jnp.log(pace(state, own.fed or own)) + config.warp_scale * action[-1]
        chosen = jnp.exp(jnp.clip(chosen, *config.warp_limits))
        # Who could hurry through the hold would end in the air, and never land.
        return jnp.where(state.phase < over, chosen, 1.0), pace(state, own)

    def around(state: EnvState, dphase: jax.Array) -> tuple[SimState, list[jax.Array]]:
        """Returns the simulation with its objects in place, and what they and holds are told."""
        own, sim, told = pick(variants, state.variant), state.sim, []
        if scene is not None:
            sim, more = scene.before(sim, own.body, state.phase, dphase)
            told.append(more)
        if own.holds is not None:
            bodies = kinematics.kinematics(tree, own.body, sim.qpos, sim.qvel)
            within = state.phase % length if loop else state.phase
            told.append(holds.controls(own.holds, bodies, within / length))
        return sim, told

    def advance(
        state: EnvState, action: jax.Array, taken: tuple[jax.Array, jax.Array]
    ) -> tuple[SimState, jax.Array]:
        base, speed = neutral, jnp.zeros(layout.nv)
        if config.feedforward:
            own, chosen = pick(variants, state.variant), taken[0]
            made = own.fed or own
            base, ahead = sample(layout, made.motion, state.phase + config.lead * chosen)
            ahead *= chosen / pace(state, made) if config.time_warp else 1.0
            speed = ahead if config.velocity_feedforward else speed
        push = action[: len(dofs)]
        target = pose.plus(layout, base, jnp.zeros(layout.nv).at[dofs].set(push))
        sim, told = around(state, taken[0])

        def substep(sim: SimState, _: None) -> tuple[SimState, jax.Array]:
            ctrl = servo.controls(servos, layout, sim, target, speed, CONTROL_DT / config.substeps)
            whole = jnp.concatenate((*told, ctrl))
            return physics.step(variants.model, state.variant, sim, whole), ctrl

        sim, ctrl = jax.lax.scan(substep, sim, None, length=config.substeps)
        return sim, ctrl[-1]

    def imitation(seen: _Seen) -> jax.Array:
        return rewards.imitation(
            weights, seen.offset, seen.velocity_error, seen.effectors, seen.bodies, seen.reference
        )

    def style(own: Variant, seen: _Seen, before: SimState, after: EnvState) -> jax.Array:
        earlier = kinematics.kinematics(tree, own.body, before.qpos, before.qvel)
        change = (after.sim.qvel - before.qvel) / CONTROL_DT
        rows = [np.array(joint.dofs) for joint in layout.own.joints[1:]]
        joints = jnp.stack([jnp.linalg.norm(change[row]) for row in rows])
        likeness = None
        if wanted is not None and after.window is not None:
            likeness = gram.reward(wanted, after.window, config.style.gram)
        return style_lib.reward(config.style, own.body, seen.bodies, earlier, joints, likeness)

    def reward_of(own: Variant, seen: _Seen, before: SimState, after: EnvState) -> jax.Array:
        if config.reward == "imitation":
            return imitation(seen)
        if config.reward == "style":
            return style(own, seen, before, after)
        if config.reward == "blend":
            w = config.style_weight
            return (1.0 - w) * imitation(seen) + w * style(own, seen, before, after)
        return jnp.float32(1.0)

    def tracked(
        own: Variant,
        seen: _Seen,
        before: EnvState,
        after: EnvState,
        taken: tuple[jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array | None]:
        """Returns the rate, the spike and what is known of the task then (FS eq. 5)."""
        rate = tracking_lib.reward(
            config.tracking, seen.offset, seen.bodies, seen.reference, effectors, taken
        )
        if task is None or before.known is None:
            return rate, jnp.float32(0.0), None
        earlier = kinematics.kinematics(tree, own.body, before.sim.qpos, before.sim.qvel)
        shares = before.phase / length, after.phase / length
        moments = (
            Moment(own.body, earlier, before.sim.qpos, before.sim.qvel),
            Moment(own.body, seen.bodies, after.sim.qpos, after.sim.qvel),
        )
        known, more, spike = task.step(before.known, *moments, shares, own.task)
        return task.tracking_weight * rate + more, spike, known

    def step(state: EnvState, action: jax.Array) -> tuple[EnvState, Outcome]:
        before, own = state, pick(variants, state.variant)
        dphase, natural = speeds(state, action)
        sim, ctrl = advance(state, action, (dphase, natural))
        state = dataclasses.replace(state, sim=sim, phase=state.phase + dphase, step=state.step + 1)
        seen = look(state)
        if wanted is not None and state.window is not None:
            window = gram.push(wanted, state.window, own.body, seen.bodies)
            state = dataclasses.replace(state, window=window)
        errors = bounds_lib.errors(layout, seen.whole, seen.bodies, seen.reference, seen.effectors)
        within = state.phase % length if loop else state.phase
        sizes = bounds_lib.sizes(bounds, within / length)
        sizes = sizes if state.scale is None else state.scale * sizes
        clear = ground.clearance(own.shapes, seen.bodies)
        touching = jnp.any(clear[forbidden] <= 0.0)
        diverged = sim.diverged | ~jnp.all(jnp.isfinite(errors))
        inside = jnp.all(errors <= sizes) & ~touching & ~diverged
        # Who may lie on the ground cannot fall: then leaving the bounds is what loses the skill.
        fallen = jnp.any(clear[no_touch] <= 0.0) if len(no_touch) else ~inside
        left, fell = ~inside & (config.stop != "fall"), fallen & (config.stop != "bounds")
        terminated = left | fell | diverged
        truncated = (state.step >= max_steps) | (state.phase >= end)
        worst, out = jnp.argmax(errors / sizes).astype(jnp.int32), jnp.any(errors > sizes)
        others = len(bounds.names) + jnp.arange(len(OTHER_ENDINGS), dtype=jnp.int32)
        ended_by = jnp.where(left, jnp.where(out, worst, others[0]), others[1])
        ended_by = jnp.where(diverged, others[2], jnp.where(terminated, ended_by, others[3]))
        torque = servo.applied_torque(servos, layout, sim.qpos, sim.qvel, ctrl)
        report = Report(errors, sizes, inside, fallen, ended_by, seen.bodies.com, torque)
        rate = jnp.float32(0.0)
        if config.reward == "tracking":
            rate, spike, known = tracked(own, seen, before, state, (dphase, natural))
            state = dataclasses.replace(state, known=known)
        else:
            spike = reward_of(own, seen, before.sim, state)
        outcome = Outcome(
            obs=features(state, seen),
            rate=jnp.where(terminated, 0.0, rate),
            spike=jnp.where(terminated, 0.0, spike),
            dphase=dphase,
            terminated=terminated,
            truncated=truncated & ~terminated,
            report=report,
        )
        return state, outcome

    size = len(dofs) + config.time_warp
    return Environment(start, place, observe_state, step, size, endings, length, end)


def validate(config: EnvConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 1 <= config.substeps <= 100:
        raise UserError(f"env.substeps is {config.substeps}: give 1 to 100 (20 is 600 Hz)")
    if not CONTROL_DT <= config.seconds <= 3600:
        raise UserError(f"env.seconds is {config.seconds}: give 1/30 to 3600 s")
    styled = config.reward in ("style", "blend")
    if styled != (config.style.style != "none"):
        raise UserError(
            f"env.reward is {config.reward}, env.style.style is {config.style.style}: a style needs"
            " the reward style or blend, and these need a style"
        )
    if not 0 <= config.style_weight <= 1:
        raise UserError(f"env.style_weight is {config.style_weight}: give 0 to 1")
    style_lib.validate(config.style)
    tracking_lib.validate(config.tracking)
    if not config.warp_limits[0] <= 0.0 <= config.warp_limits[1]:
        raise UserError(f"env.warp_limits is {config.warp_limits}: give low <= 0 <= high")
    if not 3 <= config.hold <= 3000:
        raise UserError(f"env.hold is {config.hold}: give 3 to 3000 control frames")
    if not -30 <= config.lead <= 30:
        raise UserError(f"env.lead is {config.lead}: give -30 to 30 control frames")
