# SPDX-License-Identifier: Apache-2.0
"""Holding a bar: only near it and at its time, and well enough to hang from it."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character, clip, pose, retarget
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, core, holds, obstacles, task, variants
from jaxskills.env.core import EnvConfig
from jaxskills.env.holds import Grip
from jaxskills.env.task import TaskSpec
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies

GRIP = Grip(("left_wrist", "right_wrist"), begin=0.3, end=0.6)


def _holding(who: Character, grip: Grip, height: float = 2.3) -> Character:
    return task.placed(TaskSpec(scenery=(obstacles.bar((0.56, 0.0), height, grip=grip),)), who)


@pytest.fixture(scope="module")
def who() -> Character:
    return _holding(character.load("humanoid34"), GRIP)


def test_what_may_be_held_is_in_the_model(who: Character):
    found = holds.of(who.model)
    assert found is not None and holds.of(character.load("humanoid34").model) is None
    assert found.body == (who.body("left_wrist"), who.body("right_wrist"))
    np.testing.assert_allclose(found.middle, [[0.56, 0.0, 2.3]] * 2, atol=1e-6)
    np.testing.assert_allclose(found.phase, [[0.3, 0.6]] * 2, atol=1e-6)
    np.testing.assert_allclose((found.reach, found.half), [[0.1, 0.1], [0.6, 0.6]], atol=1e-6)
    assert who.model.nu == 6 + len(who.actuated)


@pytest.mark.parametrize(
    ("place", "share", "held"),
    [
        ((0.56, 0.2, 2.3), 0.5, True),
        ((0.56, 0.2, 2.39), 0.5, True),  # within reach
        ((0.56, 0.2, 2.41), 0.5, False),
        ((0.63, 0.2, 2.22), 0.5, False),  # 10.6 cm away
        ((0.56, 0.59, 2.3), 0.5, True),  # anywhere along the bar
        ((0.56, 0.61, 2.3), 0.5, False),
        ((0.56, 0.2, 2.3), 0.29, False),  # not yet
        ((0.56, 0.2, 2.3), 0.61, False),  # no longer
    ],
)
def test_near_enough_at_the_right_phase(who: Character, place, share: float, held: bool):
    found = holds.of(who.model)
    assert found is not None
    count = len(who.body_names)
    pos = jnp.zeros((count, 3)).at[who.body("left_wrist")].set(jnp.array(place))
    rot, zero = jnp.tile(jnp.eye(3), (count, 1, 1)), jnp.zeros((count, 3))
    bodies = Bodies(pos, rot, zero, zero, zero[0], zero[0])
    expected = [float(held)] * 3 + [0.0] * 3
    assert holds.controls(found, bodies, jnp.float32(share)).tolist() == expected


def test_one_can_hang_from_it_and_falls_without(who: Character):
    """Half a second in the pose of the clip at 1.1 s: each hand carries 220 N, 2.2 cm lower."""
    qpos = retarget.retarget(who, clip.load("swing"))[33]
    targets = np.asarray(pose.rotation_vectors(who.layout, jnp.asarray(qpos)))[who.actuated]
    for on in (1.0, 0.0):
        data = mujoco.MjData(who.model)
        data.qpos[:], data.ctrl[:6], data.ctrl[6:] = qpos, on, targets
        for _ in range(60):
            mujoco.mj_step(who.model, data)
        apart = [
            np.linalg.norm(data.body(f"{side}_wrist").xpos[[0, 2]] - [0.56, 2.3])
            for side in ("left", "right")
        ]
        assert (max(apart) < 0.04) == bool(on)
        if on:
            pull = data.actuator_force[:6].reshape(2, 3)
            np.testing.assert_allclose(pull[:, 2].sum(), who.mass * 9.8, rtol=0.2)
            assert np.abs(data.qvel).max() < 5.0


def test_the_environment_tells_the_engine(tmp_path):
    """Controls of what is held come before those of the servos, in the phase of the grip."""
    plain = tiny.load_character(tmp_path)
    walker = _holding(plain, Grip(("torso",), 0.5, 1.0), height=0.6)
    sizes, config = bounds.make(walker, bounds.BoundsConfig()), EnvConfig()
    stand = tiny.make_motion(walker, tiny.standing(31), False)
    made = core.make(walker, variants.one(walker, stand, None), tiny.stopped(), sizes, config)
    step = jit(made.step)
    qpos = jnp.asarray(tiny.standing()[0], jnp.float32).at[0].set(0.56)
    for share, held in ((0.4, 0.0), (0.7, 1.0)):
        state = jax.jit(made.place)(share * made.length, qpos, jnp.zeros(11))
        ctrl = step(state, jnp.zeros(5))[0].sim.qacc[-8:]
        assert ctrl[:3].tolist() == [held] * 3
        np.testing.assert_allclose(ctrl[3:], 0.0, atol=1e-5)


def test_out_of_range(who: Character):
    plain = character.load("humanoid34")
    for changes, message in (
        ({"hands": ()}, "grip of no hand from 0.3 to 0.6: name bodies"),
        ({"begin": 0.6}, "grip of left_wrist, right_wrist from 0.6 to 0.6"),
        ({"end": 1.5}, "from 0.3 to 1.5"),
        ({"reach": 0.0}, "grip reach is 0: give a number above 0"),
        ({"damping": float("nan")}, "grip damping is nan"),
    ):
        with pytest.raises(UserError, match=message):
            _holding(plain, dataclasses.replace(GRIP, **changes))
