# SPDX-License-Identifier: Apache-2.0
"""The pose manifold against MuJoCo's own, and its identities."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxskills import pose

# Ball before hinge before free: nothing may rely on an order.
_MIXED = """
<mujoco>
  <worldbody>
    <body><joint name="b" type="ball"/><geom size="0.1"/>
      <body><joint name="h" type="hinge"/><geom size="0.1"/>
        <body><joint name="s" type="slide"/><joint name="t" type="hinge" axis="1 0 0"/>
          <geom size="0.1"/></body></body></body>
    <body><freejoint name="f"/><geom size="0.1"/>
      <body><joint name="c" type="ball"/><geom size="0.1"/></body></body>
  </worldbody>
</mujoco>
"""
_ONLY = "<mujoco><worldbody><body><joint type='{}'/><geom size='0.1'/></body></worldbody></mujoco>"


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(_MIXED)


def _random_poses(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.tile(model.qpos0, (count, 1))
    for row in poses:
        mujoco.mj_integratePos(model, row, rng.normal(0, 1.0, model.nv), 1.0)
    return poses


def _steps(model: mujoco.MjModel, count: int, seed: int) -> np.ndarray:
    """Returns displacements `[count, nv]` whose rotations stay below pi, some zero."""
    d = np.random.default_rng(seed).uniform(-1.7, 1.7, (count, model.nv))
    d[0] = 0.0
    d[1] *= 1e-6
    return d


def _close(a, b, atol: float = 3e-6):
    np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def test_layout_names_kinds_and_addresses(model: mujoco.MjModel):
    layout = pose.Layout.of(model)
    found = [(j.name, j.kind, j.qpos, list(j.dofs)) for j in layout.joints]
    assert found == [
        ("b", "ball", 0, [0, 1, 2]),
        ("h", "hinge", 4, [3]),
        ("s", "slide", 5, [4]),
        ("t", "hinge", 6, [5]),
        ("f", "free", 7, [6, 7, 8, 9, 10, 11]),
        ("c", "ball", 14, [12, 13, 14]),
    ]
    assert (layout.nq, layout.nv) == (18, 15)
    assert hash(layout) == hash(pose.Layout.of(model))


def test_plus_is_integrate_pos(model: mujoco.MjModel):
    layout, q, d = pose.Layout.of(model), _random_poses(model, 30, 0), _steps(model, 30, 1)
    moved = q.copy()
    for row, step in zip(moved, d, strict=True):
        mujoco.mj_integratePos(model, row, step, 1.0)
    _close(pose.plus(layout, jnp.asarray(q), jnp.asarray(d)), moved)


def test_minus_is_differentiate_pos(model: mujoco.MjModel):
    layout, a, b = pose.Layout.of(model), _random_poses(model, 30, 0), _random_poses(model, 30, 1)
    expected = np.zeros((30, model.nv))
    for row, x, y in zip(expected, a, b, strict=True):
        mujoco.mj_differentiatePos(model, row, 1.0, y, x)
    _close(pose.minus(layout, jnp.asarray(a), jnp.asarray(b)), expected, 1e-5)


def test_minus_undoes_plus(model: mujoco.MjModel):
    layout, q, d = pose.Layout.of(model), _random_poses(model, 30, 0), _steps(model, 30, 1)
    q, d = jnp.asarray(q, jnp.float32), jnp.asarray(d, jnp.float32)
    _close(pose.minus(layout, pose.plus(layout, q, d), q), d, 1e-5)


def test_minus_does_not_see_the_sign_of_a_quaternion(model: mujoco.MjModel):
    layout, (a, b) = pose.Layout.of(model), _random_poses(model, 2, 0)
    other = a.copy()
    other[0:4] *= -1.0
    other[10:14] *= -1.0
    plain = pose.minus(layout, jnp.asarray(a), jnp.asarray(b))
    _close(pose.minus(layout, jnp.asarray(other), jnp.asarray(b)), plain)


def test_lerp_meets_both_ends_and_the_middle(model: mujoco.MjModel):
    layout = pose.Layout.of(model)
    a, b = (jnp.asarray(_random_poses(model, 9, seed), jnp.float32) for seed in (0, 1))
    _close(pose.lerp(layout, a, b, jnp.zeros(9)), a)
    end = pose.lerp(layout, a, b, jnp.ones(9))
    _close(pose.minus(layout, end, b), np.zeros((9, model.nv)), 1e-5)
    middle = pose.lerp(layout, a, b, jnp.full(9, 0.5))
    half = 0.5 * pose.minus(layout, b, a)
    _close(pose.minus(layout, middle, a), half, 1e-5)
    _close(pose.minus(layout, b, middle), half, 1e-5)


def test_normalize_only_scales_quaternions(model: mujoco.MjModel):
    layout, q = pose.Layout.of(model), _random_poses(model, 4, 0)
    scaled = q.copy()
    for first in (0, 10, 14):
        scaled[:, first : first + 4] *= 1.7
    _close(pose.normalize(layout, jnp.asarray(scaled)), q)


def test_rotation_vectors_are_what_servos_measure(model: mujoco.MjModel):
    """A servo on a ball joint measures its rotation vector, one on a hinge the angle."""
    spec = mujoco.MjSpec.from_string(_MIXED)
    for joint, axes in (("b", 3), ("h", 1), ("s", 1), ("c", 3)):
        for axis in range(axes):
            gear = np.eye(6)[axis]
            spec.add_actuator(target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, gear=gear)
    driven = spec.compile()
    data = mujoco.MjData(driven)
    layout = pose.Layout.of(driven)
    for qpos in _random_poses(driven, 5, 2):
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(driven, data)
        found = pose.rotation_vectors(layout, jnp.asarray(qpos))
        _close(np.asarray(found)[[0, 1, 2, 3, 4, 12, 13, 14]], data.actuator_length, 5e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-4, np.pi - 1e-3])
def test_gradients_are_finite_at_rest_and_near_half_a_turn(model: mujoco.MjModel, angle: float):
    layout = pose.Layout.of(model)
    q = jnp.asarray(_random_poses(model, 1, 0)[0], jnp.float32)
    d = np.zeros(model.nv, np.float32)
    d[[0, 9, 13]] = angle

    def there_and_back(d: jax.Array) -> jax.Array:
        return pose.minus(layout, pose.plus(layout, q, d), q)

    _close(jax.jacobian(there_and_back)(jnp.asarray(d)), np.eye(model.nv), 2e-3)


@pytest.mark.parametrize("kind", ["ball", "hinge", "slide", "free"])
def test_models_with_one_kind_of_joint(kind: str):
    model = mujoco.MjModel.from_xml_string(_ONLY.format(kind))
    layout, q, d = pose.Layout.of(model), _random_poses(model, 3, 0), _steps(model, 3, 1)
    q, d = jnp.asarray(q, jnp.float32), jnp.asarray(d, jnp.float32)
    _close(pose.minus(layout, pose.plus(layout, q, d), q), d, 1e-5)
