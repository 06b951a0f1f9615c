# SPDX-License-Identifier: Apache-2.0
"""A box to push: friction, hands that stick in their phase, and its path, in C MuJoCo."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character as character_lib
from jaxskills import objects, recipes, trainer
from jaxskills.character import Character
from jaxskills.env import measure, push, task
from jaxskills.env.measure import Moment
from jaxskills.env.push import Box
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.motion import Motion
from jaxskills.physics.base import start
from jaxskills.trainer import TrainConfig

STEP = 1.0 / 120.0  # s
FACE = 0.5  # m
# Narrow, so that it fits between the feet, which stand out farther than the torso.
BOX = Box(("torso",), begin=0.2, end=0.8, face=FACE, size=(1.0, 0.1, 1.4))
TORSO = 0.06  # m, its radius


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


@pytest.fixture(scope="module")
def leap(who: Character) -> Motion:
    """The walker glides ahead by 1 m, back by 0.1 m in between, in 30 control frames."""
    qpos = tiny.standing(31)
    qpos[:, 0] = np.interp(np.arange(31), [0, 14, 17, 30], [0.0, 0.6, 0.5, 1.0])
    return tiny.make_motion(who, qpos, False)


@pytest.fixture(scope="module")
def pusher(who: Character, leap: Motion) -> Character:
    return objects.add(who, leap, [push.box(BOX)])[0]


def _weightless(spec: mujoco.MjSpec) -> None:
    spec.option.gravity = [0.0, 0.0, 0.0]


def _before_the_box(pusher: Character, apart: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Returns the walker adrift, its torso that far before the face."""
    model = character_lib.placed(pusher, [_weightless], STEP).model
    data = mujoco.MjData(model)
    data.qpos[:3] = FACE - TORSO - apart, 0.0, 0.7
    return model, data


def _apart(data: mujoco.MjData) -> float:
    """Returns the distance of the torso from the face, m."""
    geom, box = data.body("torso").id, data.geom("box").id
    geom = int(data.model.body_geomadr[geom])
    return mujoco.mj_geomDistance(data.model, data, geom, box, 5.0, None)


def _pull(pusher: Character, force: float, phases: np.ndarray, apart: float = 0.0) -> np.ndarray:
    """Returns the distances from the face while the torso is pulled back, one for each phase."""
    model, data = _before_the_box(pusher, apart)
    scene = objects.scene(pusher, 30.0)
    assert scene is not None
    found = []
    for phase in phases:
        state = start(jnp.asarray(data.qpos), jnp.asarray(data.qvel))
        _, data.ctrl[:1] = scene.before(state, None, jnp.float32(phase), jnp.float32(1.0))
        data.body("torso").xfrc_applied[0] = -force
        mujoco.mj_step(model, data, nstep=4)
        mujoco.mj_kinematics(model, data)
        found.append(_apart(data))
    return np.array(found)


DURING = np.arange(8.0, 20.0)


@pytest.mark.parametrize("force", [0.0, 60.0, 150.0, 250.0])
def test_a_hand_that_pulls_back_stays(pusher: Character, force: float):
    apart = _pull(pusher, force, DURING)
    assert -0.015 < apart.min() and apart.max() < 0.5 * BOX.near
    assert abs(apart[-1]) < 0.002


def test_the_box_comes_along_with_the_hand(pusher: Character):
    """Together they have the momentum of 200 N less the friction."""
    model, data = _before_the_box(pusher, 0.0)
    data.ctrl[0] = 1.0
    data.body("torso").xfrc_applied[0] = -200.0
    mujoco.mj_step(model, data, nstep=60)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    found = BOX.mass * data.qvel[-1] + pusher.mass * data.subtree_linvel[1, 0]
    expected = -(200.0 - BOX.friction * 9.81 * BOX.mass) * 60 * STEP
    assert data.qvel[-1] < -1.0 and found == pytest.approx(expected, rel=0.05)


def test_who_pulls_harder_than_the_grip_comes_loose(pusher: Character):
    assert _pull(pusher, 1500.0, DURING)[-1] > 0.1


@pytest.mark.parametrize("phases", [np.arange(0.0, 6.0), np.arange(24.0, 30.0)])
def test_a_hand_is_free_outside_of_the_phase(pusher: Character, phases: np.ndarray):
    assert _pull(pusher, 60.0, phases)[-1] > 0.1


def test_a_hand_is_released_at_the_end(pusher: Character):
    apart = _pull(pusher, 60.0, np.arange(18.0, 30.0))
    assert apart[:6].max() < 0.002 and apart[-1] > 0.05


def test_only_a_hand_that_is_near_is_drawn(pusher: Character):
    drawn, left = (_pull(pusher, 0.0, DURING, apart)[-1] for apart in (0.008, 0.012))
    assert abs(drawn) < 0.003
    assert left == pytest.approx(0.012, abs=1e-4)


@pytest.mark.parametrize(
    ("share", "sticks"), [(0.0, 0), (0.199, 0), (0.201, 1), (0.5, 1), (0.799, 1), (0.801, 0)]
)
def test_when_hands_stick(pusher: Character, share: float, sticks: float):
    scene = objects.scene(pusher, 30.0)
    assert scene is not None
    nq, nv = pusher.layout.nq, pusher.layout.nv
    sim, ctrl = scene.before(
        start(jnp.ones(nq), jnp.ones(nv)), None, jnp.float32(30.0 * share), jnp.float32(1.0)
    )
    assert ctrl.tolist() == [sticks]
    np.testing.assert_array_equal(sim.qpos, 1.0)


def _heavy(pusher: Character, factor: float) -> mujoco.MjModel:
    change = push.mass(BOX)
    changes = [lambda spec: change(spec, pusher, factor)]
    return character_lib.placed(pusher, changes, STEP).model


@pytest.mark.parametrize("factor", [0.5, 1.0, 10.0])
def test_the_box_slides_to_a_stop(pusher: Character, factor: float):
    model = _heavy(pusher, factor)
    assert model.body("box").mass[0] == pytest.approx(18.0 * factor)
    data = mujoco.MjData(model)
    data.qpos[0] = -5.0
    data.qvel[-1] = 1.0
    mujoco.mj_step(model, data, nstep=24)
    assert data.qvel[-1] == pytest.approx(1.0 - 0.3 * 9.81 * 24 * STEP, abs=0.01)
    mujoco.mj_step(model, data, nstep=24)
    assert data.qvel[-1] == pytest.approx(0.0, abs=1e-3)
    assert data.qpos[-1] == pytest.approx(0.5 / (0.3 * 9.81), abs=0.01)


@pytest.mark.parametrize("factor", [0.5, 1.0, 10.0])
def test_the_box_moves_once_the_push_beats_friction(pusher: Character, factor: float):
    model, friction = _heavy(pusher, factor), 0.3 * 9.81 * 18.0 * factor
    for share, expected in ((0.9, 0.0), (1.2, 0.2 * 0.3 * 9.81 * 0.5)):
        data = mujoco.MjData(model)
        data.qpos[0] = -5.0
        data.qfrc_applied[-1] = share * friction
        mujoco.mj_step(model, data, nstep=60)
        assert data.qvel[-1] == pytest.approx(expected, abs=0.01)


def test_the_path_is_that_of_the_hands_and_never_back(who: Character, leap: Motion):
    shown = objects.add(who, leap, [push.box(BOX)])[1]
    path, hands = np.asarray(shown.qpos[:, -1]), np.asarray(leap.qpos[:, 0])
    np.testing.assert_allclose(path[:7], 0.0, atol=1e-6)
    np.testing.assert_allclose(path[6:15], hands[6:15] - hands[6], atol=1e-5)
    np.testing.assert_allclose(path[14:19], path[14], atol=0.04)
    assert (np.diff(path) >= 0.0).all()
    np.testing.assert_allclose(path[24:], hands[24] - hands[6], atol=1e-5)


def test_the_distance_is_a_measure(who: Character, leap: Motion, pusher: Character):
    moment = Moment(None, None, jnp.arange(14.0), jnp.zeros(12))  # type: ignore
    assert float(push.travel(BOX)(pusher)(moment)) == 13.0
    asked = Parameter("distance", (1.0, 1.0), measure=measure.at(0.9, push.travel(BOX)))
    whole, shown = objects.add(who, leap, [push.box(BOX)])
    found = task.reference_values(TaskSpec((asked,)), whole, shown)
    assert found[0] == pytest.approx(float(shown.qpos[-1, -1]), abs=1e-5)


def test_the_reference_has_its_hands_on_the_box():
    """Nothing of the body is in it, and the hands touch it while they push."""
    recipe = recipes.find("push_family")
    assert recipe.task is not None
    who = character_lib.load(recipe.character)
    shown = trainer.reference(TrainConfig(clip=recipe.clip), who)
    whole, shown = objects.add(who, shown, recipe.task.objects)
    model, data = whole.model, mujoco.MjData(whole.model)
    box = model.geom("box").id
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    others = {a if b == box else b for a, b in pairs if box in (a, b)}
    hands = {model.geom(f"{side}_wrist").id for side in ("left", "right")}
    assert hands < others and len(others) == 15
    frames = shown.qpos.shape[0]
    for i in range(0, frames, 3):
        data.qpos[:] = shown.qpos[i]
        mujoco.mj_kinematics(model, data)
        apart = {g: mujoco.mj_geomDistance(model, data, box, g, 5.0, None) for g in others}
        assert min(apart[g] for g in others - hands) > 0.05
        if 0.16 < i / (frames - 1) < 0.8:
            assert max(abs(apart[g]) for g in hands) < 0.01
    assert float(shown.qpos[-1, -1]) == pytest.approx(1.2, abs=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hands": ()}, "box.hands is empty: name the bodies that push"),
        ({"begin": 0.9}, "box.begin is 0.9, box.end 0.8: give 0 <= begin < end <= 1"),
        ({"size": (1.0, 0.0, 1.0)}, "box.size is (1.0, 0.0, 1.0): give numbers above 0"),
        ({"mass": -1.0}, "box.mass is -1.0: give numbers above 0"),
        ({"friction": -0.1}, "box.friction is -0.1: give 0 or more"),
        ({"near": -0.1}, "box.near is -0.1: give 0 or more"),
        ({"grip": float("inf")}, "box.grip is inf: give 0 or more"),
    ],
)
def test_a_broken_box(changes: dict, message: str):
    with pytest.raises(UserError) as raised:
        push.box(dataclasses.replace(BOX, **changes))
    assert str(raised.value) == message


def test_a_hand_that_is_none(who: Character, leap: Motion):
    with pytest.raises(UserError) as raised:
        objects.add(who, leap, [push.box(dataclasses.replace(BOX, hands=("fin",)))])
    assert str(raised.value) == (
        "unknown body that pushes 'fin': choose one of pelvis, torso, left_leg, right_leg"
    )


def test_the_mass_of_no_box(who: Character):
    with pytest.raises(UserError) as raised:
        character_lib.placed(who, [lambda spec: push.mass(BOX)(spec, who, 2.0)], STEP)
    assert str(raised.value).startswith("unknown object beside walker 'box'")
