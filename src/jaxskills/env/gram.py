# SPDX-License-Identifier: Apache-2.0
"""Style learnt from data: how the features of a motion go together (SB section 3.3, eq. 6).

An encoder turns a few frames of motion into hidden features. The Gram matrix of the features over a
stretch of motion says which of them occur together, whenever they do: its style. The stretch is
kept in the environment's state, since the reward looks back over it.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import kinematics, rotation
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies, BodyParams
from jaxskills.motion import CONTROL_DT, Motion

_LEAST_NORM = 1e-6  # of a Gram matrix that is divided by it

Encode = Callable[[jax.Array], jax.Array]  # frames [T, D] -> hidden features [T - K + 1, C]


@struct.dataclass
class Window:
    """The motion up to now, one row for each control step, the newest last."""

    frames: jax.Array  # [K, D] what the encoder sees at once
    hidden: jax.Array  # [W, C] what it made of it, step by step


@struct.dataclass
class Table:
    """A motion's frames and hidden features at its F evenly spaced poses, both ends included."""

    frames: jax.Array  # [F, D]
    hidden: jax.Array  # [F, C] of the K control frames up to a pose
    length: jax.Array  # [] control frames from the first pose to the last
    loop: bool = struct.field(pytree_node=False)


@struct.dataclass
class Style:
    """The style that is wanted, and the reference that fills the window of a new episode."""

    target: jax.Array  # [C, C] Gram matrix of the style clip
    reference: Table
    axis: jax.Array  # [3] horizontal body axis that gives the heading
    encode: Encode = struct.field(pytree_node=False)
    width: int = struct.field(pytree_node=False)  # K, frames that the encoder sees at once
    steps: int = struct.field(pytree_node=False)  # W, control steps that the reward looks back


def frame(params: BodyParams, bodies: Bodies, axis: jax.Array) -> jax.Array:
    """Returns the features `[D]` of one frame, D = 3 N + 4.

    Centres of mass of the N bodies in m, seen from the ground under the root along its heading;
    the root's velocity in that frame in m/s; how fast the root turns about the vertical in rad/s.

    Args:
      params: of the bodies.
      bodies: where they are.
      axis: `[3]` horizontal body axis that gives the heading.
    """
    heading = rotation.heading(bodies.rot[0], axis)
    origin = bodies.pos[0] * jnp.array([1.0, 1.0, 0.0])
    # Centres, for they tell how heads and feet are turned; origins do not.
    centers = bodies.pos + rotation.turn(bodies.rot, params.center)
    local = rotation.turn_back(heading, centers - origin)
    velocity = rotation.turn_back(heading, bodies.lin[0])
    return jnp.concatenate((local.reshape(-1), velocity, bodies.ang[0, 2:]))


def frames_of(character: Character, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns the features `[T, D]` of poses `qpos [T, nq]` that move with `qvel [T, nv]`."""
    tree, params = kinematics.tree(character.model), kinematics.body_params(character.model)
    axis = forward(character)

    def one(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        return frame(params, kinematics.kinematics(tree, params, qpos, qvel), axis)

    return jax.vmap(one)(qpos, qvel)


def forward(character: Character) -> jax.Array:
    """Returns the axis `[3]` that gives the heading of all features: where the character faces."""
    return jnp.asarray(character.forward / np.linalg.norm(character.forward), jnp.float32)


def matrix(hidden: jax.Array) -> jax.Array:
    """Returns the Gram matrix `[C, C]` of features `hidden [T, C]`, as a mean over time.

    The mean makes stretches of different lengths comparable.
    """
    return hidden.T @ hidden / hidden.shape[0]


def distance(target: jax.Array, other: jax.Array) -> jax.Array:
    """Returns how far apart two Gram matrices `[C, C]` are, each brought to norm 1 before.

    From 0, the same style, to the square root of 2, no feature in common. SB eq. 6 leaves open
    which norm, here Frobenius', and the scale of the features. Were they not brought to one norm,
    a run, whose features are larger, would be far from every walk whatever its style.
    """
    unit = lambda m: m / jnp.maximum(jnp.linalg.norm(m), _LEAST_NORM)  # noqa: E731
    return jnp.linalg.norm(unit(target) - unit(other))


def table(motion: Motion, frames: jax.Array, encode: Encode, width: int) -> Table:
    """Returns the table of a motion.

    Args:
      motion: which.
      frames: `[F, D]` features of its poses.
      encode: the encoder.
      width: K, control frames that it sees at once.

    Raises:
      UserError: a motion without loop that is shorter than what the encoder sees at once.
    """
    if not motion.loop and float(motion.length) < width:
        raise UserError(
            f"a motion of {motion.seconds:.2f} s without loop is too short for an encoder of"
            f" {width} control frames: give a longer one, or one that loops"
        )
    bare = Table(frames, frames, motion.length, motion.loop)
    phase = jnp.linspace(0.0, motion.length, frames.shape[0])
    seen = phase[:, None] - jnp.arange(width)[::-1]
    hidden = jax.vmap(lambda at: encode(_rows(bare, frames, at))[0])(seen)
    return dataclasses.replace(bare, hidden=hidden)


def style_of(table: Table, width: int) -> jax.Array:
    """Returns the Gram matrix `[C, C]` of a whole motion: of a cycle, or from its start to its end.

    Args:
      table: of the motion.
      width: K, control frames that the encoder saw at once.
    """
    if table.loop:
        return matrix(table.hidden[:-1])
    # Before that many have gone by, the encoder sees the first pose held.
    intervals = table.hidden.shape[0] - 1
    first = int(np.ceil((width - 1) / float(table.length) * intervals))
    return matrix(table.hidden[first:])


def make(
    character: Character,
    reference: Motion,
    clip: Motion,
    encode: Encode,
    width: int,
    look_back: float | None = None,
) -> Style:
    """Returns the style of a clip, for a character that follows `reference`.

    Args:
      character: who.
      reference: what it follows.
      clip: whose style is wanted.
      encode: the encoder.
      width: K, control frames that it sees at once.
      look_back: s that the reward looks back over; None: a cycle of the reference.

    Raises:
      UserError: a motion without loop that is shorter than what the encoder sees at once.
    """
    look = jit(lambda qpos, qvel: frames_of(character, qpos, qvel))
    tables = [table(m, look(m.qpos, m.qvel), encode, width) for m in (reference, clip)]
    steps = reference.length if look_back is None else look_back / CONTROL_DT
    target, axis = style_of(tables[1], width), forward(character)
    return Style(target, tables[0], axis, encode, width, max(1, round(float(steps))))


def fill(style: Style, phase: jax.Array) -> Window:
    """Returns the window of an episode that begins at `phase []`: the reference up to there.

    The paper does not say what a new episode looks back on. The reference is where it starts from.
    """
    back = lambda count: phase - jnp.arange(count)[::-1]  # noqa: E731
    seen, past = back(style.width), back(style.steps)
    rows = style.reference
    return Window(_rows(rows, rows.frames, seen), _rows(rows, rows.hidden, past))


def push(style: Style, window: Window, params: BodyParams, bodies: Bodies) -> Window:
    """Returns the window one control step later, which led to `bodies`."""
    newest = frame(params, bodies, style.axis)
    frames = jnp.concatenate((window.frames[1:], newest[None]))
    return Window(frames, jnp.concatenate((window.hidden[1:], style.encode(frames))))


def reward(style: Style, window: Window, scale: float) -> jax.Array:
    """Returns the reward `[]` in (0, 1] of a window (SB eq. 6); `scale` is alpha."""
    return jnp.exp(-distance(style.target, matrix(window.hidden)) / scale)


def _rows(table: Table, rows: jax.Array, phase: jax.Array) -> jax.Array:
    """Returns `rows [F, X]` of a table at `phase [T]` (control frames, any), linear in between."""
    intervals = rows.shape[0] - 1
    cycle = jnp.floor(phase / table.length) if table.loop else jnp.zeros_like(phase)
    inside = jnp.clip(phase - cycle * table.length, 0.0, table.length)
    place = inside / table.length * intervals
    low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, intervals - 1)
    share = (place - low)[:, None]
    return rows[low] + share * (rows[low + 1] - rows[low])
