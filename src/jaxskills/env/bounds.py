# SPDX-License-Identifier: Apache-2.0
"""Spacetime bounds: how far a state may be from the reference at each phase (SB section 3).

One row of errors per state, one size per channel: a state is inside while every error is at most
its size. Channels are named, so that training can say which bound ended an episode and where.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import pose, rotation
from jaxskills.character import Character
from jaxskills.errors import UserError, unknown
from jaxskills.kinematics import Bodies

Size = float | tuple[float, ...]

_COM = ("com_x", "com_y", "com_z")


@dataclasses.dataclass(frozen=True)
class BoundsConfig:
    """Sizes of the bounds, scalars or one value per knot of phase (evenly spread over a cycle).

    Defaults are the authors' own (SB section 5.1 prints 0.2 m for the horizontal ones too).
    """

    com: tuple[float, float, float] = (0.3, 0.3, 0.2)  # m: x, y, up
    root: float = 0.7  # rad
    joints: float = 0.7  # rad
    end_effectors: float = 0.5  # m, in the heading frame
    # Channel name (a joint, `NAME_position`, com_x, com_y, com_z, root) to its own size.
    channels: Mapping[str, Size] = dataclasses.field(default_factory=dict)
    # Bodies that must not touch the ground, besides what the other bounds say.
    no_ground_contact: tuple[str, ...] = ()


@struct.dataclass
class Bounds:
    """Sizes over P knots of phase. K channels: CoM x, y, up, root, joints, end effectors."""

    sizes: jax.Array  # [P, K] m or rad
    names: tuple[str, ...] = struct.field(pytree_node=False)  # K channels
    forbidden: tuple[int, ...] = struct.field(pytree_node=False)  # bodies


def channel_names(character: Character) -> tuple[str, ...]:
    """Returns the K channel names of a character, in the order of `errors`."""
    joints = tuple(joint.name for joint in character.layout.joints[1:])
    return (*_COM, "root", *joints, *(f"{name}_position" for name in character.end_effectors))


def make(character: Character, config: BoundsConfig) -> Bounds:
    """Returns the bounds of a configuration.

    Raises:
      UserError: an unknown channel or body, or a size that is not a positive number.
    """
    names = channel_names(character)
    joints, effectors = len(character.layout.joints) - 1, len(character.end_effectors)
    default = (*config.com, config.root, *(config.joints,) * joints)
    by_name: dict[str, Size] = dict(
        zip(names, (*default, *(config.end_effectors,) * effectors), strict=True)
    )
    for name, size in config.channels.items():
        if name not in by_name:
            raise unknown("bound", name, names)
        by_name[name] = size
    tables = {name: np.atleast_1d(np.asarray(size, float)) for name, size in by_name.items()}
    for name, table in tables.items():
        if table.ndim != 1 or not table.size or not (table > 0).all():
            raise UserError(f"bound {name} is {by_name[name]}: give positive sizes (m or rad)")
    knots = max(len(table) for table in tables.values())
    columns = [_spread(table, knots) for table in tables.values()]
    forbidden = tuple(character.body(name) for name in config.no_ground_contact)
    return Bounds(jnp.asarray(np.stack(columns, 1), jnp.float32), names, forbidden)


def sizes(bounds: Bounds, share: jax.Array) -> jax.Array:
    """Returns the sizes `[K]` at a `share []` of the cycle, linear between knots, held after 1."""
    knots = bounds.sizes.shape[0]
    if knots == 1:
        return bounds.sizes[0]
    place = jnp.clip(share, 0.0, 1.0) * (knots - 1)
    low = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, knots - 2)
    return bounds.sizes[low] + (place - low) * (bounds.sizes[low + 1] - bounds.sizes[low])


def errors(
    layout: pose.Layout,
    offset: jax.Array,
    bodies: Bodies,
    reference: Bodies,
    effectors: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Returns the error `[K]` of each channel (SB section 5.1).

    Args:
      layout: of the poses.
      offset: `[nv]` displacement from the simulated pose to the reference.
      bodies: the simulated bodies.
      reference: the reference's bodies at the same phase.
      effectors: end effector positions `[E, 3]` of both, each in its own heading frame.
    """
    com = jnp.abs(bodies.com - reference.com)
    root = jnp.linalg.norm(offset[3:6], keepdims=True)
    joints = [jnp.linalg.norm(offset[np.array(j.dofs)]) for j in layout.joints[1:]]
    distance = jnp.linalg.norm(effectors[0] - effectors[1], axis=-1)
    return jnp.concatenate((com, root, jnp.stack(joints), distance))


def heading_effectors(bodies: Bodies, indices: tuple[int, ...], axis: jax.Array) -> jax.Array:
    """Returns the end effectors `[E, 3]` seen from the ground under the root, along its heading."""
    frame = rotation.heading(bodies.rot[0], axis)
    origin = bodies.pos[0] * jnp.array([1.0, 1.0, 0.0])
    return rotation.turn_back(frame, bodies.pos[np.array(indices, int)] - origin)


def _spread(table: np.ndarray, knots: int) -> np.ndarray:
    """Returns the table at `knots` even places."""
    if len(table) == 1:
        return np.full(knots, table[0])
    return np.interp(np.linspace(0, 1, knots), np.linspace(0, 1, len(table)), table)
