# SPDX-License-Identifier: Apache-2.0
"""Spacetime bounds: how far a state may be from the reference at each phase (SB section 3).

One row of errors per state, one size per channel: a state is inside while every error is at most
its size. Channels are named, so that training can say which bound ended an episode and where.
"""

import dataclasses
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import pose, rotation
from jaxskills.character import Character
from jaxskills.errors import UserError, unknown
from jaxskills.kinematics import Bodies

# A number, numbers evenly spread over a cycle, or knots (share of the cycle, size) in any places.
Size = float | tuple[float, ...] | tuple[tuple[float, float], ...]

_COM = ("com_x", "com_y", "com_z")
_FINEST = 200  # steps of a cycle that knots are resampled to, unless fewer meet them all
OPEN = 1e6  # m or rad, instead of infinity, to which no line leads


@dataclasses.dataclass(frozen=True)
class BoundsConfig:
    """Sizes of the bounds; infinity switches one off.

    Defaults are the authors' own (SB section 5.1 prints 0.2 m for the horizontal ones too). A size
    over the cycle is linear between its knots and held before the first and after the last.
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
    """Sizes over P knots of phase.

    K channels: CoM x, y, up, root, joints, end effectors, and last the joints of objects, which are
    open unless `BoundsConfig.channels` names them.
    """

    sizes: jax.Array  # [P, K] m or rad
    names: tuple[str, ...] = struct.field(pytree_node=False)  # K channels
    forbidden: tuple[int, ...] = struct.field(pytree_node=False)  # bodies


def channel_names(character: Character) -> tuple[str, ...]:
    """Returns the K channel names of a character, in the order of `errors`."""
    own, others = _joints(character.layout)
    effectors = (f"{name}_position" for name in character.end_effectors)
    return (*_COM, "root", *(j.name for j in own), *effectors, *(j.name for j in others))


def channel_units(character: Character) -> tuple[str, ...]:
    """Returns the K units of a character's channels, `m` or `rad`."""
    (own, others), effectors = _joints(character.layout), len(character.end_effectors)
    lengths = effectors + len(others)
    return (*("m",) * len(_COM), "rad", *("rad",) * len(own), *("m",) * lengths)


def default_sizes(character: Character, config: BoundsConfig) -> tuple[float, ...]:
    """Returns the K sizes that hold where `config.channels` names no other."""
    (own, others), effectors = _joints(character.layout), len(character.end_effectors)
    return (
        *config.com,
        config.root,
        *(config.joints,) * len(own),
        *(config.end_effectors,) * effectors,
        *(math.inf,) * len(others),
    )


def make(character: Character, config: BoundsConfig) -> Bounds:
    """Returns the bounds of a configuration.

    Raises:
      UserError: see `table`.
    """
    sizes = jnp.asarray(table(character, config), jnp.float32)
    forbidden = tuple(character.body(name) for name in config.no_ground_contact)
    return Bounds(sizes, channel_names(character), forbidden)


def table(character: Character, config: BoundsConfig) -> np.ndarray:
    """Returns the sizes `[P, K]` at even steps of the cycle, one row if none changes over it.

    The steps are the fewest that meet all knots, if 200 do; with 200 a corner between two steps is
    cut by at most half a percent of the cycle.

    Raises:
      UserError: an unknown channel or body, a size that is not a positive number, knots that are
        out of order or of the cycle.
    """
    names = channel_names(character)
    by_name: dict[str, Size] = dict(zip(names, default_sizes(character, config), strict=True))
    for name, size in config.channels.items():
        if name not in by_name:
            raise unknown("bound", name, names)
        by_name[name] = size
    for name in config.no_ground_contact:
        character.body(name)
    knots = [_knots(name, size) for name, size in by_name.items()]
    grid = np.linspace(0.0, 1.0, _steps([shares for shares, _ in knots]) + 1)
    columns = [np.interp(grid, shares, np.minimum(values, OPEN)) for shares, values in knots]
    return np.stack(columns, axis=1)


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
      layout: of the poses, with objects.
      offset: `[nv]` displacement from the simulated pose to the reference.
      bodies: the simulated bodies.
      reference: the reference's bodies at the same phase.
      effectors: end effector positions `[E, 3]` of both, each in its own heading frame.
    """
    com = jnp.abs(bodies.com - reference.com)
    root = jnp.linalg.norm(offset[3:6], keepdims=True)
    own, others = _joints(layout)
    joints = [jnp.linalg.norm(offset[np.array(j.dofs)]) for j in own]
    distance = jnp.linalg.norm(effectors[0] - effectors[1], axis=-1)
    beside = [jnp.abs(offset[j.dof])[None] for j in others]
    return jnp.concatenate((com, root, jnp.stack(joints), distance, *beside))


def heading_effectors(bodies: Bodies, indices: tuple[int, ...], axis: jax.Array) -> jax.Array:
    """Returns the end effectors `[E, 3]` seen from the ground under the root, along its heading."""
    frame = rotation.heading(bodies.rot[0], axis)
    origin = bodies.pos[0] * jnp.array([1.0, 1.0, 0.0])
    return rotation.turn_back(frame, bodies.pos[np.array(indices, int)] - origin)


def _joints(layout: pose.Layout) -> tuple[tuple[pose.Joint, ...], tuple[pose.Joint, ...]]:
    """Returns the joints of the character besides its root, and those of objects."""
    own = len(layout.own.joints)
    return layout.joints[1:own], layout.joints[own:]


def _knots(name: str, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Returns the shares of the cycle and the sizes there, both `[k]`."""
    try:
        values: np.ndarray = np.atleast_1d(np.asarray(size, float))
    except (TypeError, ValueError):
        values = np.empty(0)
    shares: np.ndarray = np.linspace(0.0, 1.0, len(values))
    if values.ndim == 2 and values.shape[-1] == 2:
        shares, values = values[:, 0], values[:, 1]
    if values.ndim != 1 or not values.size or not (values > 0).all():
        raise UserError(
            f"bound {name} is {size}: give positive sizes (m or rad), or knots [share, size]"
        )
    if not ((shares >= 0) & (shares <= 1)).all() or not (np.diff(shares) > 0).all():
        raise UserError(
            f"bound {name} has knots at {', '.join(f'{share:g}' for share in shares)}: give"
            " shares of the cycle that rise from 0 to 1"
        )
    return shares, values


def _steps(shares: list[np.ndarray]) -> int:
    """Returns the fewest even steps of the cycle that meet all shares, or the most allowed."""
    several = [one for one in shares if len(one) > 1]
    if not several:
        return 0
    places = np.unique(np.concatenate(several))
    most = max(_FINEST, *(len(one) - 1 for one in several))
    for steps in range(1, most):
        if np.abs(places * steps - np.round(places * steps)).max() < 1e-6:
            return steps
    return most
