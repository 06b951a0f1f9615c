# SPDX-License-Identifier: Apache-2.0
"""Quaternions and rotation vectors: identities, scipy as reference, gradients where it hurts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxskills import rotation


def _vectors(largest: float, count: int = 200) -> np.ndarray:
    """Returns rotation vectors `[count, 3]` with angles from 1e-7 rad to `largest`."""
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(count, 3))
    angles = np.geomspace(1e-7, largest, count)
    return axes / np.linalg.norm(axes, axis=1, keepdims=True) * angles[:, None]


def _quats(count: int = 50, seed: int = 0) -> np.ndarray:
    return Rotation.random(count, rng=seed).as_quat(scalar_first=True)


def _close(a, b, atol: float = 2e-6):
    np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def test_log_undoes_exp():
    v = _vectors(3.1)
    _close(rotation.log(rotation.exp(jnp.asarray(v, jnp.float32))), v, 3e-6)


def test_log_undoes_exp_in_double_precision():
    v = _vectors(3.14159)
    with jax.enable_x64(True):
        found = np.asarray(rotation.log(rotation.exp(jnp.asarray(v, jnp.float64))))
    np.testing.assert_allclose(found, v, rtol=1e-12, atol=1e-15)


def test_exp_undoes_log_up_to_sign():
    q = _quats()
    back = np.asarray(rotation.exp(rotation.log(jnp.asarray(q))))
    _close(back * np.sign(np.sum(back * q, 1, keepdims=True)), q)


def test_exp_and_log_agree_with_scipy():
    v = _vectors(3.1)
    _close(rotation.exp(jnp.asarray(v)), Rotation.from_rotvec(v).as_quat(scalar_first=True))
    q = _quats()
    _close(rotation.log(jnp.asarray(q)), Rotation.from_quat(q, scalar_first=True).as_rotvec(), 5e-6)


def test_log_is_the_shorter_way():
    q = jnp.asarray(_quats(200))
    assert float(rotation.angle(q).max()) <= np.pi + 1e-5
    np.testing.assert_array_equal(rotation.log(q), rotation.log(-q))


def test_products_agree_with_scipy():
    a, b, v = _quats(seed=1), _quats(seed=2), np.random.default_rng(3).normal(size=(50, 3))
    ra, rb = (Rotation.from_quat(q, scalar_first=True) for q in (a, b))
    product = Rotation.from_quat(rotation.mul(jnp.asarray(a), jnp.asarray(b)), scalar_first=True)
    _close(product.as_matrix(), (ra * rb).as_matrix())
    _close(rotation.to_matrix(jnp.asarray(a)), ra.as_matrix())
    _close(rotation.rotate(jnp.asarray(a), jnp.asarray(v)), ra.apply(v), 5e-6)
    _close(rotation.mul(jnp.asarray(a), rotation.inv(jnp.asarray(a))), [[1, 0, 0, 0]] * 50)
    _close(rotation.normalize(jnp.asarray(3.0 * a)), a)


def test_matrices_turn_vectors_and_each_other():
    a, b = (Rotation.random(20, rng=seed).as_matrix() for seed in (1, 2))
    v = np.random.default_rng(3).normal(size=(20, 3))
    ja, jb, jv = (jnp.asarray(x, jnp.float32) for x in (a, b, v))
    _close(rotation.turn(ja, jv), Rotation.from_matrix(a).apply(v))
    _close(rotation.turn_back(ja, jv), Rotation.from_matrix(a).inv().apply(v))
    _close(rotation.compose(ja, jb), a @ b)
    # One matrix for many vectors, and columns instead of whole matrices.
    _close(rotation.turn(ja[0], jv), v @ a[0].T)
    _close(rotation.turn_back(ja[0], jv), v @ a[0])
    _close(rotation.compose(ja[0], jb[:, :, :2]), a[0] @ b[:, :, :2])


def test_cross_and_skew():
    a, b = np.random.default_rng(0).normal(size=(2, 20, 3))
    _close(rotation.cross(jnp.asarray(a), jnp.asarray(b)), np.cross(a, b))
    _close(jnp.einsum("nij,nj->ni", rotation.skew(jnp.asarray(a)), jnp.asarray(b)), np.cross(a, b))


def test_slerp_goes_from_one_to_the_other_at_even_speed():
    a, b = jnp.asarray(_quats(seed=1), jnp.float32), jnp.asarray(_quats(seed=2), jnp.float32)
    whole = rotation.angle(rotation.mul(rotation.inv(a), b))
    for share in (0.0, 0.25, 0.5, 1.0):
        between = rotation.slerp(a, b, jnp.full(50, share))
        gone = rotation.angle(rotation.mul(rotation.inv(a), between))
        left = rotation.angle(rotation.mul(rotation.inv(between), b))
        # Near pi a float32 quaternion knows its angle to a thousandth only at its tip.
        _close(gone, share * whole, 5e-4)
        _close(left, (1.0 - share) * whole, 5e-4)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 1e-4, 1.1e-4, 1.0, np.pi - 1e-3, np.pi])
def test_gradients_are_finite_and_right(size: float):
    axis = np.array([0.36, -0.48, 0.8])
    v = jnp.asarray(size * axis, jnp.float32)
    jacobian = np.asarray(jax.jacobian(rotation.exp)(v))
    assert np.isfinite(jacobian).all()
    # d exp / d v along the axis is half a unit quaternion ahead by a right angle.
    expected = 0.5 * np.array([-np.sin(size / 2), *(np.cos(size / 2) * axis)])
    _close(jacobian @ axis, expected)
    back = np.asarray(jax.jacobian(lambda v: rotation.log(rotation.exp(v)))(v))
    assert np.isfinite(back).all()
    # Rotating about the same axis undoes itself; beyond pi the log flips, so stay below.
    if size < np.pi:
        _close(back @ axis, axis, 1e-4)


def test_gradients_of_the_angle_at_rest_are_finite():
    grad = jax.grad(lambda v: jnp.sum(rotation.log(rotation.exp(v)) ** 2))(jnp.zeros(3))
    np.testing.assert_array_equal(grad, np.zeros(3))


@pytest.mark.parametrize("yaw", [-3.0, -0.5, 0.0, 1.0, 2.5])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.8, 0.0)])
def test_heading_of_a_turn_about_the_vertical_is_that_turn(yaw: float, axis):
    matrix = Rotation.from_euler("z", yaw).as_matrix()
    _close(rotation.to_matrix(rotation.about_z(jnp.float32(yaw))), matrix)
    found = rotation.heading(jnp.asarray(matrix, jnp.float32), jnp.array(axis))
    _close(found, matrix)


@pytest.mark.parametrize("pitch", [-1.0, 0.4, 1.5, 1.7, 3.0])
def test_only_the_lateral_heading_stands_a_somersault(pitch: float):
    yaw = Rotation.from_euler("z", 0.7).as_matrix()
    body = jnp.asarray(yaw @ Rotation.from_euler("y", pitch).as_matrix(), jnp.float32)
    _close(rotation.heading(body, jnp.array([0.0, 1.0, 0.0])), yaw)
    forward = rotation.heading(body, jnp.array([1.0, 0.0, 0.0]))
    flipped = yaw @ np.diag([-1.0, -1.0, 1.0])
    _close(forward, yaw if np.cos(pitch) > 0 else flipped, 2e-5)


def test_heading_is_finite_where_the_axis_is_vertical():
    up = jnp.asarray(Rotation.from_euler("y", -np.pi / 2).as_matrix(), jnp.float32)
    axis = jnp.array([1.0, 0.0, 0.0])
    value, grad = rotation.heading(up, axis), jax.jacobian(rotation.heading)(up, axis)
    assert np.isfinite(value).all()
    assert np.isfinite(grad).all()
