# SPDX-License-Identifier: Apache-2.0
"""Boxes that stand on the floor, whose tops are ground too.

A body is looked at in points with a radius: the centre of a ball, ends and middle of a capsule,
corners and faces of a box. A point over a box has the box's top below it, any other the floor.
"""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import rotation
from jaxskills.kinematics import Bodies

_TYPES = mujoco.mjtGeom
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_FACES = np.concatenate((np.eye(3), -np.eye(3)))


@struct.dataclass
class Boxes:
    """B upright boxes, and the P points that can be on them. Arrays, so variants can stack."""

    middle: jax.Array  # [B, 2] m
    along: jax.Array  # [B, 2] unit vector of its first side
    half: jax.Array  # [B, 2] m, half lengths of its sides
    top: jax.Array  # [B] m
    point: jax.Array  # [P, 3] m, in the body
    radius: jax.Array  # [P] m
    body: tuple[int, ...] = struct.field(pytree_node=False)  # [P] index among the N bodies


def boxes(model: mujoco.MjModel, geoms: Sequence[int]) -> Boxes | None:
    """Returns the boxes of the world that stand on the floor, None if there is none.

    Args:
      model: compiled.
      geoms: of the character, those that can touch the ground.
    """
    rows = [g for g in range(model.ngeom) if _is_ground(model, g)]
    if not rows:
        return None
    frame = np.zeros((len(rows), 9))
    for i, g in enumerate(rows):
        mujoco.mju_quat2Mat(frame[i], model.geom_quat[g])
    size, pos = model.geom_size[rows], model.geom_pos[rows]
    points = [(int(model.geom_bodyid[g]) - 1, *one) for g in geoms for one in _points(model, g)]
    body, point, radius = zip(*points, strict=True)
    numbers = (
        pos[:, :2],
        frame[:, [0, 3]],
        size[:, :2],
        pos[:, 2] + size[:, 2],
        np.stack(point),
        radius,
    )
    return Boxes(*(jnp.asarray(x, jnp.float32) for x in numbers), body=body)


def heights(boxes: Boxes, bodies: Bodies, inside: bool = False) -> jax.Array:
    """Returns how far above the tops of the boxes below it each point `[P]` is (m), else infinite.

    A point that is nearer to a side of a box than to its top touches that side: the top is not
    below it.

    Args:
      boxes: and points.
      bodies: where they are.
      inside: take the top as below all that is inside of a box, however deep.
    """
    owner = np.array(boxes.body, int)
    center = bodies.pos[owner] + rotation.turn(bodies.rot[owner], boxes.point)
    away = center[:, None, :2] - boxes.middle
    first = jnp.sum(away * boxes.along, -1)
    second = away[..., 1] * boxes.along[:, 0] - away[..., 0] * boxes.along[:, 1]
    depth = boxes.half - jnp.abs(jnp.stack((first, second), -1))
    beside = jnp.sqrt(jnp.sum(jnp.minimum(depth, 0.0) ** 2, -1))
    to_side = jnp.where(beside > 0.0, -beside, jnp.min(depth, -1))
    radius = boxes.radius[:, None]
    above = center[:, 2:] - boxes.top
    # Beside a box a ball can touch its edge only.
    height = above - jnp.sqrt(jnp.maximum(radius**2 - beside**2, 0.0))
    over = (beside <= radius) & (above >= -to_side)
    if inside:
        over |= beside == 0.0
    return jnp.min(jnp.where(over, height, jnp.inf), axis=-1)


def _is_ground(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is an upright box of the world that reaches down to the floor."""
    if model.geom_bodyid[geom] != 0 or model.geom_type[geom] != _TYPES.mjGEOM_BOX:
        return False
    solid = geom in (*model.pair_geom1, *model.pair_geom2)
    solid |= bool(model.geom_contype[geom] | model.geom_conaffinity[geom])
    upright = np.abs(model.geom_quat[geom, 1:3]).max() < 1e-6
    floor = model.geom_pos[model.geom("floor").id, 2]
    return bool(solid and upright and model.geom_pos[geom, 2] - model.geom_size[geom, 2] <= floor)


def _points(model: mujoco.MjModel, geom: int) -> list[tuple[np.ndarray, float]]:
    """Returns points of a geom in its body, each with a radius."""
    kind, size = _TYPES(int(model.geom_type[geom])), model.geom_size[geom]
    radius, axis = 0.0, np.array([0.0, 0.0, 1.0])
    if kind == _TYPES.mjGEOM_SPHERE:
        radius, local = float(size[0]), np.zeros((1, 3))
    elif kind == _TYPES.mjGEOM_CAPSULE:
        radius, local = float(size[0]), np.outer((-size[1], 0.0, size[1]), axis)
    elif kind == _TYPES.mjGEOM_CYLINDER:
        turn = np.arange(8) * np.pi / 4
        rim = size[0] * np.stack((np.cos(turn), np.sin(turn), 0 * turn), 1)
        local = np.concatenate([end * size[1] * axis + rim for end in (-1.0, 1.0)])
    elif kind == _TYPES.mjGEOM_ELLIPSOID:
        local = _FACES * size
    else:  # a box, or a mesh by its bounding box
        local = np.concatenate((_CORNERS, _FACES)) * size
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.geom_quat[geom])
    return [(model.geom_pos[geom] + frame.reshape(3, 3) @ one, radius) for one in local]
