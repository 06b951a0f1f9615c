# SPDX-License-Identifier: Apache-2.0
"""The observation does not tell where the walker is or faces, only how it stands to the target."""

from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny
from scipy.spatial.transform import Rotation

from jaxskills import kinematics, pose
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, observe

FORWARD, LATERAL = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
State = tuple[np.ndarray, np.ndarray]  # qpos, qvel

# Entries of the observation of 4 bodies and 3 end effectors.
_HEIGHT, _COM = 3, 4 + 9 + 24 + 12 + 12 + 9


@pytest.fixture(scope="module")
def look(who: Character) -> Callable[..., np.ndarray]:
    """Returns (state, reference state, axis, phase) -> observation, in a cycle of 30 frames."""
    tree, params = kinematics.tree(who.model), kinematics.body_params(who.model)
    effectors = tuple(who.body(name) for name in who.end_effectors)

    def features(state, reference, axis, phase):
        bodies, target = (kinematics.kinematics(tree, params, *s) for s in (state, reference))
        offset = pose.minus(who.layout, reference[0], state[0])
        seen = bounds.heading_effectors(bodies, effectors, axis)
        return observe.features(bodies, target, offset, phase, jnp.float32(30.0), axis, seen)

    compiled = jit(features)

    def call(state: State, reference: State, axis=FORWARD, phase: float = 4.0) -> np.ndarray:
        as_float = lambda pair: tuple(jnp.asarray(x, jnp.float32) for x in pair)  # noqa: E731
        arguments = (as_float(state), as_float(reference), jnp.array(axis), jnp.float32(phase))
        return np.asarray(compiled(*arguments))

    return call


def _random_state(who: Character, seed: int) -> State:
    rng = np.random.default_rng(seed)
    qpos = tiny.walking()[seed]
    mujoco.mj_integratePos(who.model, qpos, rng.normal(0, 0.3, who.layout.nv), 1.0)
    return qpos, rng.normal(0, 1.0, who.layout.nv)


def _carried(state: State, yaw: float, shift: tuple[float, float]) -> State:
    """Returns the state turned about the vertical and shifted along the ground (m)."""
    turn = Rotation.from_euler("z", yaw)
    qpos, qvel = state[0].copy(), state[1].copy()
    qpos[:3] = turn.apply(qpos[:3]) + (*shift, 0.0)
    qpos[3:7] = (turn * Rotation.from_quat(qpos[3:7], scalar_first=True)).as_quat(scalar_first=True)
    qvel[:3] = turn.apply(qvel[:3])
    return qpos, qvel


@pytest.mark.parametrize("axis", [FORWARD, LATERAL])
@pytest.mark.parametrize("yaw", [0.5, -2.0, 3.1])
def test_turning_and_shifting_the_world_changes_nothing(
    who: Character, look: Callable, axis, yaw: float
):
    state, reference = _random_state(who, 1), _random_state(who, 2)
    plain = look(state, reference, axis)
    both = [_carried(s, yaw, (3.0, -2.0)) for s in (state, reference)]
    np.testing.assert_allclose(look(*both, axis), plain, rtol=0, atol=2e-5)


def test_the_two_headings_differ_for_a_tilted_body(who: Character, look: Callable):
    state, reference = _random_state(who, 1), _random_state(who, 2)
    assert np.abs(look(state, reference, FORWARD) - look(state, reference, LATERAL)).max() > 1e-2


@pytest.mark.parametrize("carry", [(0.0, (0.1, 0.0)), (0.0, (0.0, 0.1)), (0.2, (0.0, 0.0))])
def test_drifting_from_the_reference_shows(who: Character, look: Callable, carry):
    state, reference = _random_state(who, 1), _random_state(who, 2)
    drifted = look(_carried(state, *carry), reference)
    assert np.abs(drifted - look(state, reference)).max() > 0.05


def test_how_far_ahead_the_reference_is_shows_along_the_heading(who: Character, look: Callable):
    qpos, qvel = tiny.standing(1)[0], np.zeros(who.layout.nv)
    ahead = qpos.copy()
    ahead[:3] += (0.3, 0.1, 0.05)
    fast = qvel.copy()
    fast[:3] = (1.0, 0.0, 0.5)
    for yaw in (0.0, 1.2):
        seen = look(_carried((qpos, qvel), yaw, (1, 1)), _carried((ahead, fast), yaw, (1, 1)))
        np.testing.assert_allclose(seen[_COM : _COM + 3], [0.3, 0.1, 0.05], atol=1e-5)
        np.testing.assert_allclose(seen[_COM + 3 : _COM + 6], [1.0, 0.0, 0.5], atol=1e-5)
        np.testing.assert_allclose(seen[_COM + 6 :], 0.0, atol=1e-5)


def test_the_offset_of_every_joint_and_of_the_root_shows(who: Character, look: Callable):
    qpos, still = tiny.standing(1)[0], np.zeros(who.layout.nv)
    d = np.array([0, 0, 0, 0.1, 0.2, -0.1, 0.3, 0.1, 0.2, -0.4, 0.5])
    target = qpos.copy()
    mujoco.mj_integratePos(who.model, target, d, 1.0)
    seen = look((qpos, still), (target, still))
    np.testing.assert_allclose(seen[-8:], d[3:], atol=1e-5)


def test_height_and_phase(who: Character, look: Callable):
    qpos, still = tiny.standing(1)[0], np.zeros(who.layout.nv)
    seen = look((qpos, still), (qpos, still), phase=7.5)
    np.testing.assert_allclose(seen[: _HEIGHT + 1], [1.0, 0.0, 0.25, 0.5], atol=1e-6)
    # The third tells the first cycle's phase: a held last pose is not the start again.
    np.testing.assert_allclose(look((qpos, still), (qpos, still), phase=45.0)[2], 1.0)
    assert seen.shape == (_COM + 6 + 3 + 5,)
