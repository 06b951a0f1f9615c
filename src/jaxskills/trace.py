# SPDX-License-Identifier: Apache-2.0
"""Traces of episodes, told over phase instead of time: what FS section 5.1 learns from.

An episode is T rows of states, a row for each control step it lasted and the rest unused. Rows are
brought to fixed knots of phase by linear interpolation. An episode that starts late or ends early
has its nearest row at the knots outside; `coverage` says how much of the motion it went through.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills import pose, rotation
from jaxskills.motion import Motion, sample
from jaxskills.variation import Variation

_JUMP = 3.2  # rad, a little more than half a turn: that much between two rows is no motion


class Neighbours(NamedTuple):
    """Rows between which each of N knots lies."""

    low: jax.Array  # [N] int
    high: jax.Array  # [N] int
    share: jax.Array  # [N] of the way from the one to the other


def usable(valid: jax.Array, *rows: jax.Array) -> jax.Array:
    """Returns which rows `[T]` are valid and finite throughout (`rows` are `[T, ...]`)."""
    for row in rows:
        valid = valid & jnp.isfinite(row.reshape(row.shape[0], -1)).all(-1)
    return valid


def neighbours(phase: jax.Array, valid: jax.Array, knots: jax.Array) -> Neighbours:
    """Returns the valid rows around each of `knots [N]`, one of them twice outside the episode.

    Args:
      phase: `[T]` of the rows, rising strictly where valid.
      valid: `[T]` bool; without any, row 0 is taken.
      knots: `[N]` phases.
    """
    before = valid & (phase <= knots[:, None])
    after = valid & (phase > knots[:, None])
    low = jnp.argmax(jnp.where(before, phase, -jnp.inf), axis=1)
    high = jnp.argmin(jnp.where(after, phase, jnp.inf), axis=1)
    low = jnp.where(before.any(1), low, high)
    high = jnp.where(after.any(1), high, low)
    width = phase[high] - phase[low]
    inside = width > 0.0
    share = jnp.where(inside, (knots - phase[low]) / jnp.where(inside, width, 1.0), 0.0)
    return Neighbours(low, high, share)


def coverage(motion: Motion, phase: jax.Array, valid: jax.Array) -> jax.Array:
    """Returns the share `[]` of the motion, or of its first cycle, between first and last row."""
    first = jnp.min(jnp.where(valid, phase, jnp.inf))
    last = jnp.max(jnp.where(valid, phase, -jnp.inf))
    covered = jnp.minimum(last, motion.length) - jnp.maximum(first, 0.0)
    return jnp.maximum(covered / motion.length, 0.0)


def align(qpos: jax.Array, first: jax.Array, target: jax.Array) -> jax.Array:
    """Returns poses `[T, nq]` turned about the vertical and shifted level, `first` onto `target`.

    The turn is the one about the vertical that brings the root of `first [nq]` nearest to that of
    `target [nq]`, whichever way up they are. Height and tilt stay.
    """
    apart = rotation.mul(target[3:7], rotation.inv(first[3:7]))
    turn = rotation.about_z(2.0 * jnp.arctan2(apart[3], apart[0]))
    level = jnp.array([1.0, 1.0, 0.0])
    pos = rotation.rotate(turn, qpos[:, :3] - level * first[:3]) + level * target[:3]
    return jnp.concatenate((pos, rotation.mul(turn, qpos[:, 3:7]), qpos[:, 7:]), axis=1)


def trace_to_variation(
    layout: pose.Layout,
    motion: Motion,
    qpos: jax.Array,
    phase: jax.Array,
    tau: jax.Array,
    valid: jax.Array,
    knots: int,
) -> tuple[Variation, jax.Array]:
    """Returns the variation that an episode performed, and its coverage `[]` (FS section 5.1).

    The episode is first aligned with the reference, by its first row. There the simulation stands
    where it was put, so that row is free of noise, and what a skill is about (how far a jump goes,
    how far a turn) is left to grow from it. A fit over the whole episode would move half of that
    to its beginning, away from the objects that stand around it. The authors' code does the same.

    Rotations are followed from row to row beyond half a turn, where the shortest displacement would
    jump to the other side. At a whole turn that ends, since a rotation vector has no axis there: an
    episode in which one jumps by more than half a turn between two rows is said to cover nothing.

    Args:
      layout: of what varies: `Layout.own` leaves objects out, which are no part of a motion.
      motion: the reference `m_0`.
      qpos: `[T, nq]` simulated poses.
      phase: `[T]` control frames, rising strictly where valid. In a loop the first cycle counts.
      tau: `[T]` of the step that begins in a row; the last row repeats the one before.
      valid: `[T]` bool, rows that belong to the episode; rows that are not finite are left out.
      knots: K of the variation.
    """
    valid = usable(valid, qpos, phase, tau)
    qpos, phase = jnp.where(valid[:, None], qpos, motion.qpos[0]), jnp.where(valid, phase, 0.0)
    reference = jax.vmap(lambda one: sample(layout, motion, one)[0])(phase)
    first = jnp.argmax(valid)
    d = pose.minus(layout, align(qpos, qpos[first], reference[first]), reference)
    d, steady = _followed(layout, jnp.where(valid[:, None], d, 0.0), valid)
    tau = jnp.where(valid, tau, 0.0)
    near = neighbours(phase, valid, jnp.linspace(0.0, 1.0, knots) * motion.length)
    share = near.share
    found = Variation(
        d[near.low] + share[:, None] * (d[near.high] - d[near.low]),
        tau[near.low] + share * (tau[near.high] - tau[near.low]),
    )
    return found, jnp.where(steady, coverage(motion, phase, valid), 0.0)


def _followed(layout: pose.Layout, d: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns displacements `d [T, nv]` with rotation vectors the nearest to those a row before.

    A rotation vector and the same one longer by whole turns are one rotation. Also whether none
    jumps `[]`.
    """
    turns = _rotation_dofs(layout)

    def step(last: jax.Array, row: tuple[jax.Array, jax.Array]):
        vector, used = row[0][turns], row[1]
        size = jnp.linalg.norm(vector, axis=1, keepdims=True)
        # No turn at all has no axis: it may be whole turns about the axis so far.
        still = size < 1e-6
        axis = jnp.where(still, last, vector)
        axis = axis / jnp.maximum(jnp.linalg.norm(axis, axis=1, keepdims=True), 1e-6)
        whole = jnp.round((jnp.sum(axis * last, 1, keepdims=True) - size) / (2.0 * jnp.pi))
        vector = jnp.where(whole == 0.0, vector, axis * (size + 2.0 * jnp.pi * whole))
        vector = jnp.where(used, vector, last)
        jump = jnp.max(jnp.linalg.norm(vector - last, axis=1))
        return vector, (row[0].at[turns].set(vector), jump)

    _, (d, jumps) = jax.lax.scan(step, jnp.zeros(turns.shape), (d, valid))
    return d, jnp.all(jumps < _JUMP)


def _rotation_dofs(layout: pose.Layout) -> np.ndarray:
    """Returns the displacement indices `[Q, 3]` that are rotation vectors."""
    rows = [joint.dofs[-3:] for joint in layout.joints if joint.kind in ("free", "ball")]
    return np.array(rows, np.int32).reshape(-1, 3)
