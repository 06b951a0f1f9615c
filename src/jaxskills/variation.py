# SPDX-License-Identifier: Apache-2.0
"""Variations of a motion: displaced poses and a warped time (FS section 3, eq. 1 to 3).

A variation is K rows at even knots of phase, from 0 to the motion's length: a displacement of the
pose and the log of the speed at which phase goes by. Both are linear between knots. A row of zeros
is the reference itself, at its own speed of one control frame of phase per control frame.

A motion that loops is varied over its one cycle, and the next cycle begins where that has led to:
there, as high, and heading that way. Its ends are not made to meet, or else a jump onto a box would
end half on the box, and a longer turn would turn by half of the rest. So joints and tilt jump from
the last knot to the first, where one cycle goes over into the next.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import pose, rotation
from jaxskills.errors import UserError
from jaxskills.motion import CONTROL_DT, Motion

# Speeds are kept within exp(-4) and exp(4), 1/55 to 55: phase in float32 would stand still below
# and overflow above. FS demands that time never stalls, whatever tau is.
TAU_LIMIT = 4.0


@dataclasses.dataclass(frozen=True)
class VariationConfig:
    """How finely a variation is described."""

    knot_every: float = 2.0  # control frames of phase
    fewest_knots: int = 16  # however short the motion is


@struct.dataclass
class Variation:
    """K knots of phase. Arrays, so many of them stack; zeros are the reference."""

    d: jax.Array  # [K, nv] displacement of the pose (m, rad), FS eq. 2
    tau: jax.Array  # [K] log of the speed of phase


def knot_count(config: VariationConfig, motion: Motion) -> int:
    """Returns K for a motion, on the host."""
    return max(config.fewest_knots, round(float(motion.length) / config.knot_every) + 1)


def zeros(knots: int, nv: int) -> Variation:
    """Returns the variation of `knots` rows that changes nothing."""
    return Variation(jnp.zeros((knots, nv)), jnp.zeros(knots))


def flatten(variation: Variation) -> jax.Array:
    """Returns `x [..., K (nv + 1)]`, knot by knot, each its displacement and then its tau."""
    rows = jnp.concatenate((variation.d, variation.tau[..., None]), axis=-1)
    return rows.reshape(*rows.shape[:-2], -1)


def unflatten(x: jax.Array, nv: int) -> Variation:
    """Returns the variation of `x [..., M]`, the inverse of `flatten`."""
    rows = x.reshape(*x.shape[:-1], -1, nv + 1)
    return Variation(rows[..., :nv], rows[..., nv])


def displace(layout: pose.Layout, motion: Motion, variation: Variation) -> Motion:
    """Returns the motion `m_a` of a variation, on the frames of `motion` (FS eq. 1 and 2).

    Its velocities are those of its performance, per second: how the displaced pose changes along
    phase, times the speed of phase. Its length stays one of phase; `duration` has the seconds.
    Where the displacement is one of the character alone (`Layout.own`), objects keep their paths.
    """
    variation = _limited(variation)
    share = jnp.linspace(0.0, 1.0, motion.qpos.shape[0])
    d = _between(variation.d, share)
    if d.shape[1] < layout.nv:
        d = jnp.pad(d, ((0, 0), (0, layout.nv - d.shape[1])))
    slope = _slopes(motion, d)
    qpos = pose.plus(layout, motion.qpos, d)

    def onward(time: jax.Array) -> jax.Array:
        undisplaced = pose.plus(layout, motion.qpos, time * motion.qvel)
        return pose.minus(layout, pose.plus(layout, undisplaced, d + time * slope), qpos)

    _, qvel = jax.jvp(onward, (jnp.float32(0.0),), (jnp.float32(1.0),))
    speed = jnp.exp(_between(variation.tau, share))
    yaw, pos = _next_cycle(motion, qpos) if motion.loop else (motion.cycle_yaw, motion.cycle_pos)
    return dataclasses.replace(
        motion, qpos=qpos, qvel=speed[:, None] * qvel, cycle_yaw=yaw, cycle_pos=pos
    )


def rate(motion: Motion, variation: Variation, phase: jax.Array) -> jax.Array:
    """Returns how fast phase goes by at `phase [...]`, in control frames per control frame.

    That is exp(tau), in every cycle of a loop; beyond the ends of another motion it is as there.
    """
    variation = _limited(variation)
    share = phase / motion.length
    share = share - jnp.floor(share) if motion.loop else jnp.clip(share, 0.0, 1.0)
    return jnp.exp(_between(variation.tau, share))


def duration(motion: Motion, variation: Variation) -> jax.Array:
    """Returns how many seconds `[]` the variation takes from phase 0 to its end.

    It is the integral of exp(-tau) over phase. Control steps of FS eq. 3 take it with the speed at
    their beginning, and so differ by a fraction of a step.
    """
    tau = _limited(variation).tau
    rise = tau[1:] - tau[:-1]
    even = jnp.abs(rise) < 1e-2
    slowness = jnp.where(
        even,
        1.0 - rise / 2.0 + rise**2 / 6.0,
        -jnp.expm1(-rise) / jnp.where(even, 1.0, rise),
    )
    return jnp.mean(jnp.exp(-tau[:-1]) * slowness) * motion.length * CONTROL_DT


def warp(tau: jax.Array) -> jax.Array:
    """Returns the phases `[T + 1]` that steps of `tau [T]` lead through, from 0 (FS eq. 3).

    They rise strictly, whatever tau is.
    """
    steps = jnp.exp(jnp.clip(tau, -TAU_LIMIT, TAU_LIMIT))
    return jnp.concatenate((jnp.zeros_like(steps[:1]), jnp.cumsum(steps)))


def phase_at(phases: jax.Array, seconds: jax.Array) -> jax.Array:
    """Returns the phase `[...]` at a time, linear between control steps `phases [T + 1]`."""
    frames = jnp.arange(phases.shape[0], dtype=phases.dtype)
    return jnp.interp(seconds / CONTROL_DT, frames, phases)


def seconds_at(phases: jax.Array, phase: jax.Array) -> jax.Array:
    """Returns the time `[...]` in s at which a phase is reached, the inverse of `phase_at`."""
    frames = jnp.arange(phases.shape[0], dtype=phases.dtype)
    return jnp.interp(phase, phases, frames) * CONTROL_DT


def validate(config: VariationConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 0.1 <= config.knot_every <= 100:
        raise UserError(f"variation.knot_every is {config.knot_every}: give 0.1 to 100 frames")
    if not 2 <= config.fewest_knots <= 1000:
        raise UserError(f"variation.fewest_knots is {config.fewest_knots}: give 2 to 1000")


def _between(knots: jax.Array, share: jax.Array) -> jax.Array:
    """Returns what lies a `share [...]` of the way from the first of `knots [K, ...]` to the last.

    The cells between knots are straight.
    """
    cells = knots.shape[0] - 1
    place = share * cells
    low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, cells - 1)
    part = (place - low).reshape(*share.shape, *(1,) * (knots.ndim - 1))
    return knots[low] + part * (knots[low + 1] - knots[low])


def _limited(variation: Variation) -> Variation:
    """Returns the variation with speeds in their limits."""
    return Variation(variation.d, jnp.clip(variation.tau, -TAU_LIMIT, TAU_LIMIT))


def _next_cycle(motion: Motion, qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns by how much a cycle turns `[]` and moves `[3]` the next, for the poses `[F, nq]`.

    The root of the first pose is put where that of the last one is, turned about the vertical to
    come nearest to it. Told as a change from the reference's own, which it stays without any.
    """

    def heading(poses: jax.Array) -> jax.Array:
        apart = rotation.mul(poses[-1, 3:7], rotation.inv(poses[0, 3:7]))
        return 2.0 * jnp.arctan2(apart[3], apart[0])

    def step(poses: jax.Array, yaw: jax.Array) -> jax.Array:
        return poses[-1, :3] - rotation.rotate(rotation.about_z(yaw), poses[0, :3])

    turn = heading(qpos) - heading(motion.qpos)
    yaw = motion.cycle_yaw + turn - 2.0 * jnp.pi * jnp.round(turn / (2.0 * jnp.pi))
    return yaw, motion.cycle_pos + step(qpos, yaw) - step(motion.qpos, motion.cycle_yaw)


def _slopes(motion: Motion, d: jax.Array) -> jax.Array:
    """Returns how displacements `d [F, nv]` change per second at normal speed.

    Central differences, one-sided at the ends.
    """
    around = jnp.concatenate(((2.0 * d[0] - d[1])[None], d, (2.0 * d[-1] - d[-2])[None]))
    frame = motion.length * CONTROL_DT / (d.shape[0] - 1)
    return (around[2:] - around[:-2]) / (2.0 * frame)
