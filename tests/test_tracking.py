# SPDX-License-Identifier: Apache-2.0
"""The tracking reward: 1 on the motion, numbers by hand, and against loops over MuJoCo's bodies."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny
import variations

from jaxskills import kinematics
from jaxskills.character import Character
from jaxskills.env import tracking
from jaxskills.env.tracking import TrackingConfig
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies

CONFIG = TrackingConfig()
EFFECTORS = (1, 2, 3)
SAME = (jnp.float32(1.3), jnp.float32(1.3))


def _bodies(pos=((0.0, 0.0, 0.0),) * 4, com=(0.0, 0.0, 0.0)) -> Bodies:
    none = jnp.zeros((4, 3))
    here = jnp.array(pos, jnp.float32) + 2.0
    return Bodies(here, jnp.zeros((4, 3, 3)), none, none, jnp.array(com) - 1.0, jnp.zeros(3))


def _terms(offset=(), pos=((0.0, 0.0, 0.0),) * 4, com=(0.0, 0.0, 0.0), rate=SAME) -> np.ndarray:
    row = np.zeros(11)
    for index, value in offset:
        row[index] = value
    found = tracking.terms(CONFIG, jnp.asarray(row), _bodies(pos, com), _bodies(), EFFECTORS, rate)
    return np.asarray(found)


def test_the_motion_itself_is_worth_one():
    np.testing.assert_allclose(_terms(), 1.0, rtol=1e-6)
    found = tracking.reward(CONFIG, jnp.zeros(11), _bodies(), _bodies(), EFFECTORS, SAME)
    assert float(found) == pytest.approx(1.0)


def test_the_numbers_are_the_papers():
    """FS section 4.2."""
    assert dataclasses.astuple(CONFIG) == (3.16, 0.8, 0.35, 0.1, 0.28, 0.28, 0.28, 0.16)


def test_one_by_hand():
    """Joints 0.3, 0.4 and 2 rad off: 4.25; effectors 0.1 and 0.3 m: 0.1; CoM 0.1 m; speed 0.05."""
    found = _terms(
        offset=[(0, 9.0), (4, 1.0), (6, 0.3), (8, 0.4), (10, -2.0)],
        pos=((7.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, 0.0), (0.1, -0.2, 0.2)),
        com=(0.0, -0.1, 0.0),
        rate=(jnp.float32(0.95), jnp.float32(1.0)),
    )
    exponents = (4.25 / 3.16**2, 0.1 / 0.64, 0.01 / 0.35**2, 0.0025 / 0.01)
    np.testing.assert_allclose(found, np.exp(np.negative(exponents)), rtol=1e-4)


@pytest.mark.parametrize(
    ("fault", "index"),
    [
        ({"offset": [(7, 99.0)]}, 0),
        ({"pos": ((0.0, 0.0, 0.0),) * 3 + ((0.0, 9.0, 0.0),)}, 1),
        ({"com": (0.0, 0.0, 9.0)}, 2),
        ({"rate": (jnp.float32(9.0), jnp.float32(1.0))}, 3),
        ({"rate": (jnp.float32(1.0), jnp.float32(9.0))}, 3),
        ({"offset": [(0, 99.0), (5, 99.0)]}, None),  # the root is no joint
        ({"pos": ((9.0, 9.0, 9.0),) + ((0.0, 0.0, 0.0),) * 3}, None),  # the pelvis no effector
    ],
)
def test_each_fault_costs_its_term_alone(fault: dict, index: int | None):
    expected = np.ones(4)
    if index is not None:
        expected[index] = 0.0
    np.testing.assert_allclose(_terms(**fault), expected, atol=1e-6)


def test_weights_add_up_the_terms():
    config = TrackingConfig(pose_weight=0.5, end_effectors_weight=0.0, com_weight=0.2)
    com = _bodies(com=(9.0, 0.0, 0.0))
    found = tracking.reward(config, jnp.zeros(11), com, _bodies(), EFFECTORS, SAME)
    assert float(found) == pytest.approx(0.5 + 0.0 + 0.0 + 0.16)


def test_against_mujoco(who: Character):
    """A state off the motion: joints, bodies and CoM as MuJoCo has them, term by term."""
    model, random = who.model, np.random.default_rng(0)
    wanted = variations.plus(model, tiny.walking()[5], 0.1 * random.normal(size=11))
    qpos = variations.plus(model, wanted, 0.2 * random.normal(size=11))
    offset = variations.minus(model, wanted, qpos)
    errors = [0.0, 0.0, 0.0]
    seen = []
    for pose in (qpos, wanted):
        data = mujoco.MjData(model)
        data.qpos = pose
        mujoco.mj_forward(model, data)
        seen.append((data.xpos[2:].copy(), data.subtree_com[1].copy()))
    for joint in who.layout.joints[1:]:
        errors[0] += np.linalg.norm([offset[i] for i in joint.dofs]).item() ** 2
    for name in who.end_effectors:
        i = who.body(name) - 1
        errors[1] += np.linalg.norm(seen[0][0][i] - seen[1][0][i]).item() ** 2
    errors[2] = np.linalg.norm(seen[0][1] - seen[1][1]).item() ** 2
    expected = [math.exp(-e / s**2) for e, s in zip(errors, (3.16, 0.8, 0.35), strict=True)]
    expected.append(math.exp(-((0.8 - 0.85) ** 2) / 0.1**2))

    tree, params = kinematics.tree(model), kinematics.body_params(model)
    look = jax.jit(lambda q: kinematics.kinematics(tree, params, q, jnp.zeros(11)))
    here, there = (look(jnp.asarray(x, jnp.float32)) for x in (qpos, wanted))
    effectors = tuple(who.body(name) for name in who.end_effectors)
    rate = (jnp.float32(0.8), jnp.float32(0.85))
    found = tracking.terms(CONFIG, jnp.asarray(offset), here, there, effectors, rate)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    total = tracking.reward(CONFIG, jnp.asarray(offset), here, there, effectors, rate)
    assert float(total) == pytest.approx(np.dot((0.28, 0.28, 0.28, 0.16), expected), rel=1e-4)


def test_out_of_range():
    tracking.validate(CONFIG)
    for name, value in (("pose", 0.0), ("time", float("nan")), ("com_weight", -0.1)):
        with pytest.raises(UserError, match=f"tracking.{name} is"):
            tracking.validate(TrackingConfig(**{name: value}))
