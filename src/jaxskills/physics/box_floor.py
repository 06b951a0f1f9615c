# SPDX-License-Identifier: Apache-2.0
"""Box on plane for MJX, with the contacts that C MuJoCo and Warp have.

MJX keeps only the corners of a box that are within 1 mm of the lowest one, so that a foot tilted by
one degree stands on a point. C takes every corner below the plane, four at most.
"""

import contextlib
from collections.abc import Iterator

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import collision_driver, math

_CORNERS = 4


def collide(model: mjx.Model, data: mjx.Data, _key: object, geom: jax.Array) -> tuple:
    """Returns (dist [4P], pos [4P, 3], frame [4P, 3, 3]) of P pairs (plane, box), `geom` [P, 2]."""
    plane, box = geom.T
    signs = jnp.stack(jnp.meshgrid(*[jnp.array([-1.0, 1.0])] * 3, indexing="ij"), -1).reshape(8, 3)

    def pair(plane_pos, plane_mat, box_pos, box_mat, half):
        normal = plane_mat[:, 2]
        corners = box_pos + (signs * half) @ box_mat.T
        height = (corners - plane_pos) @ normal
        below, lowest = jax.lax.top_k(-height, _CORNERS)
        pos = corners[lowest] + 0.5 * below[:, None] * normal
        return -below, pos, jnp.tile(math.make_frame(normal), (_CORNERS, 1, 1))

    found = jax.vmap(pair)(
        data.geom_xpos[plane],
        data.geom_xmat[plane],
        data.geom_xpos[box],
        data.geom_xmat[box],
        model.geom_size[box],
    )
    return jax.tree.map(jnp.concatenate, found)


collide.ncon = _CORNERS  # MJX asks each of its functions for the number of contacts per pair


@contextlib.contextmanager
def installed() -> Iterator[None]:
    """Puts `collide` into MJX's table while a step is traced, and the old entry back after it."""
    table = collision_driver._COLLISION_FUNC
    pair = (mjx.GeomType.PLANE, mjx.GeomType.BOX)
    before = table[pair]
    table[pair] = collide
    try:
        yield
    finally:
        table[pair] = before
