# SPDX-License-Identifier: Apache-2.0
"""Unit quaternions (w, x, y, z) and rotation vectors, safe to differentiate everywhere.

Every function broadcasts over leading axes. A rotation vector is axis times angle, in radians.
"""

import jax
import jax.numpy as jnp

# Below this squared angle (rad^2) the Taylor series is exact in float32.
_SMALL = 1e-8


def normalize(q: jax.Array) -> jax.Array:
    """Returns `q [..., 4]` scaled to unit norm."""
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)


def mul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the product of two quaternions `[..., 4]`: first `b`, then `a`."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = aw * bw - jnp.sum(av * bv, axis=-1, keepdims=True)
    return jnp.concatenate((real, aw * bv + bw * av + cross(av, bv)), axis=-1)


def inv(q: jax.Array) -> jax.Array:
    """Returns the inverse of unit quaternions `[..., 4]`."""
    return jnp.concatenate((q[..., :1], -q[..., 1:]), axis=-1)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the cross product of `[..., 3]` vectors."""
    ahead = lambda v: jnp.concatenate((v[..., 1:], v[..., :1]), axis=-1)  # noqa: E731
    return ahead(a * ahead(b) - ahead(a) * b)


def turn(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """Returns vectors `v [..., 3]` turned by rotation matrices `[..., 3, 3]`."""
    columns = [matrix[..., :, i] * v[..., i : i + 1] for i in range(3)]
    return columns[0] + columns[1] + columns[2]


def turn_back(matrix: jax.Array, v: jax.Array) -> jax.Array:
    """Returns vectors `v [..., 3]` turned by the inverse of rotation matrices `[..., 3, 3]`."""
    rows = [matrix[..., i, :] * v[..., i : i + 1] for i in range(3)]
    return rows[0] + rows[1] + rows[2]


def compose(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the product of rotation matrices `[..., 3, 3]`: first `b`, then `a`."""
    terms = [a[..., :, i : i + 1] * b[..., i : i + 1, :] for i in range(3)]
    return terms[0] + terms[1] + terms[2]


def rotate(q: jax.Array, v: jax.Array) -> jax.Array:
    """Returns vectors `v [..., 3]` turned by `q [..., 4]`."""
    t = 2.0 * cross(q[..., 1:], v)
    return v + q[..., :1] * t + cross(q[..., 1:], t)


def exp(v: jax.Array) -> jax.Array:
    """Returns the quaternion `[..., 4]` of the rotation vector `v [..., 3]` (rad)."""
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    small = square < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    scale = jnp.where(small, 0.5 - square / 48.0, jnp.sin(0.5 * angle) / angle)
    return jnp.concatenate(
        (jnp.where(small, 1.0 - square / 8.0, jnp.cos(0.5 * angle)), scale * v), -1
    )


def log(q: jax.Array) -> jax.Array:
    """Returns the rotation vector `[..., 3]` (rad, norm at most pi) of the unit quaternion `q`."""
    q = jnp.where(q[..., :1] < 0.0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    square = jnp.sum(v * v, axis=-1, keepdims=True)
    small = square < _SMALL
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    scale = jnp.where(small, 2.0 + square / 3.0, 2.0 * jnp.arctan2(sine, w) / sine)
    return scale * v


def angle(q: jax.Array) -> jax.Array:
    """Returns the rotation angle `[...]` in [0, pi] of the unit quaternion `q [..., 4]`."""
    return jnp.linalg.norm(log(q), axis=-1)


def slerp(a: jax.Array, b: jax.Array, t: jax.Array) -> jax.Array:
    """Returns the rotation a share `t` of the shorter way from `a` to `b` (`[..., 4]`)."""
    return mul(a, exp(jnp.asarray(t)[..., None] * log(mul(inv(a), b))))


def to_matrix(q: jax.Array) -> jax.Array:
    """Returns the rotation matrices `[..., 3, 3]` of unit quaternions `[..., 4]`."""
    w, v = q[..., 0, None, None], q[..., 1:]
    outer = v[..., :, None] * v[..., None, :]
    square = w * w - jnp.sum(v * v, axis=-1)[..., None, None]
    return square * jnp.eye(3, dtype=q.dtype) + 2.0 * (outer + w * skew(v))


def skew(v: jax.Array) -> jax.Array:
    """Returns the matrices `[..., 3, 3]` whose product with a vector is the cross product."""
    zero = jnp.zeros_like(v[..., 0])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    rows = jnp.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=-1)
    return rows.reshape((*v.shape, 3))


def about_z(yaw: jax.Array) -> jax.Array:
    """Returns the quaternion `[..., 4]` that turns by `yaw [...]` (rad) about the vertical."""
    zero = jnp.zeros_like(yaw)
    return jnp.stack((jnp.cos(0.5 * yaw), zero, zero, jnp.sin(0.5 * yaw)), axis=-1)


def heading(matrix: jax.Array, axis: jax.Array) -> jax.Array:
    """Returns the rotation matrix about the vertical that turns `axis` to where the body points it.

    `axis [3]` is horizontal and fixed in the body: the facing direction, or the lateral one for
    motions that turn head over heels (SB section 4.1), whose facing passes the vertical.

    Args:
      matrix: `[3, 3]` orientation of the body.
      axis: `[3]` unit vector.
    """
    pointed = turn(matrix, axis)
    length = jnp.sqrt(jnp.maximum(pointed[0] ** 2 + pointed[1] ** 2, 1e-12))
    cosine = (axis[0] * pointed[0] + axis[1] * pointed[1]) / length
    sine = (axis[0] * pointed[1] - axis[1] * pointed[0]) / length
    zero, one = jnp.zeros_like(sine), jnp.ones_like(sine)
    return jnp.stack((cosine, -sine, zero, sine, cosine, zero, zero, zero, one)).reshape(3, 3)
