# SPDX-License-Identifier: Apache-2.0
"""How far each body is above the floor, or a box on it, from the shapes of its geoms.

One function serves the lift of a start pose out of the floor, the fall test and the clip check, the
same on every backend. The support of every primitive towards the floor has one closed form, a sum
of an edge, a ball, a disc and an ellipsoid term. Boxes that stand on the floor are in `terrain`.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import pose, rotation, terrain
from jaxskills.kinematics import Bodies

_TYPES = mujoco.mjtGeom


@struct.dataclass
class Shapes:
    """Support numbers of the G geoms that can touch the floor. Arrays, so variants can stack."""

    pos: jax.Array  # [G, 3] m, in the body
    frame: jax.Array  # [G, 3, 3] orientation in the body
    edge: jax.Array  # [G, 3] m, half lengths of a box
    ball: jax.Array  # [G] m, radius of a sphere
    disc: jax.Array  # [G] m, radius of a disc across local z
    ellipsoid: jax.Array  # [G, 3] m, half axes
    body: tuple[int, ...] = struct.field(pytree_node=False)  # [G] index among the N bodies
    boxes: terrain.Boxes | None = None  # whose tops are ground too


def shapes(model: mujoco.MjModel) -> Shapes:
    """Returns the shapes of the character's geoms that can collide with the geom `floor`."""
    rows = [g for g in range(model.ngeom) if _meets_floor(model, g)]
    rows = [g for g in rows if model.geom_bodyid[g] <= pose.own_bodies(model)]
    edge, ellipsoid = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
    ball, disc = np.zeros(len(rows)), np.zeros(len(rows))
    for i, g in enumerate(rows):
        kind, size = _TYPES(int(model.geom_type[g])), model.geom_size[g]
        if kind in (_TYPES.mjGEOM_SPHERE, _TYPES.mjGEOM_CAPSULE):
            ball[i] = size[0]
            edge[i, 2] = size[1] if kind == _TYPES.mjGEOM_CAPSULE else 0.0
        elif kind == _TYPES.mjGEOM_CYLINDER:
            disc[i], edge[i, 2] = size[0], size[1]
        elif kind == _TYPES.mjGEOM_ELLIPSOID:
            ellipsoid[i] = size
        else:
            # A box, or a mesh by its bounding box (half sizes around the geom frame).
            edge[i] = size
    body = tuple(int(i) for i in model.geom_bodyid[rows] - 1)
    frame = np.zeros((len(rows), 9))
    for i, g in enumerate(rows):
        mujoco.mju_quat2Mat(frame[i], model.geom_quat[g])
    frame = frame.reshape(-1, 3, 3)
    numbers = (model.geom_pos[rows], frame, edge, ball, disc, ellipsoid)
    arrays = (jnp.asarray(x, jnp.float32) for x in numbers)
    return Shapes(*arrays, body=body, boxes=terrain.boxes(model, rows))


def geom_clearance(shapes: Shapes, bodies: Bodies) -> jax.Array:
    """Returns how high `[G]` in m each geom's lowest point is; below 0 it is in the floor."""
    body = np.array(shapes.body, int)
    rot = bodies.rot[body]
    # The vertical seen from a body or a geom is the last row of its rotation matrix.
    center = bodies.pos[body, 2] + jnp.sum(rot[:, 2] * shapes.pos, -1)
    up = rotation.turn_back(shapes.frame, rot[:, 2])
    across = jnp.sqrt(jnp.maximum(up[:, 0] ** 2 + up[:, 1] ** 2, 0.0))
    support = jnp.sum(shapes.edge * jnp.abs(up), -1) + shapes.ball + shapes.disc * across
    support += jnp.sqrt(jnp.sum((shapes.ellipsoid * up) ** 2, -1))
    return center - support


def clearance(shapes: Shapes, bodies: Bodies, inside: bool = False) -> jax.Array:
    """Returns the height `[N]` in m of each body above the ground, infinite without geoms.

    The ground is the top of the highest box below, or the floor; `inside` is that of
    `terrain.heights`.
    """
    count = bodies.pos.shape[0]
    heights, owner = geom_clearance(shapes, bodies), shapes.body
    if shapes.boxes is not None:
        over = terrain.heights(shapes.boxes, bodies, inside)
        heights, owner = jnp.concatenate((heights, over)), (*owner, *shapes.boxes.body)
    by_body = [np.flatnonzero(np.array(owner) == body) for body in range(count)]
    lowest = [jnp.min(heights[rows]) if len(rows) else jnp.inf for rows in by_body]
    return jnp.stack([jnp.asarray(value, heights.dtype) for value in lowest])


def _meets_floor(model: mujoco.MjModel, geom: int) -> bool:
    floor = model.geom("floor").id
    if model.geom_bodyid[geom] == 0:
        return False
    pairs = {frozenset(p) for p in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    if frozenset((geom, floor)) in pairs:
        return True
    return bool(
        model.geom_contype[geom] & model.geom_conaffinity[floor]
        or model.geom_contype[floor] & model.geom_conaffinity[geom]
    )
