# SPDX-License-Identifier: Apache-2.0
"""Obstacles: solid, where and as high as they are said to be, in models of equal sizes."""

import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character, clip, ground, recipes, retarget
from jaxskills.character import Character
from jaxskills.env import obstacles, task
from jaxskills.env.holds import Grip
from jaxskills.env.task import Condition, Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.physics import base

FAMILIES = ("obstacle_jump_family", "box_jump_family", "wall_jump_family", "swing_family")
PLAIN = ("wall_jump", "swing")


@pytest.fixture(scope="module")
def who() -> Character:
    return character.load("humanoid34")


def _among(who: Character, *objects: Condition) -> mujoco.MjModel:
    return task.placed(TaskSpec(scenery=objects), who).model


def _partners(model: mujoco.MjModel, name: str) -> list[str]:
    """Names of what a geom has contact pairs with."""
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    names = [{model.geom(int(a)).name, model.geom(int(b)).name} for a, b in pairs]
    return sorted(other for pair in names if name in pair for other in pair - {name})


def test_a_box_is_as_solid_as_the_floor(who: Character):
    model = _among(who, obstacles.box((0.6, 0.1), (0.1, 0.6), 0.2, yaw=0.5))
    assert _partners(model, "box") == _partners(model, "floor")
    floor, box = (
        [i for i in range(model.npair) if model.geom(name).id in (a[i], b[i])]
        for name in ("floor", "box")
        for a, b in [(model.pair_geom1, model.pair_geom2)]
    )
    for field in ("pair_friction", "pair_solref", "pair_dim", "pair_margin"):
        values = getattr(model, field)
        np.testing.assert_array_equal(values[box], values[floor])
    found = ground.shapes(model).boxes
    assert found is not None
    np.testing.assert_allclose(found.middle, [[0.6, 0.1]], atol=1e-6)
    np.testing.assert_allclose(found.half, [[0.05, 0.3]], atol=1e-6)
    np.testing.assert_allclose(found.along, [[np.cos(0.5), np.sin(0.5)]], atol=1e-6)
    np.testing.assert_allclose(found.top, [0.2], atol=1e-6)


def test_a_character_without_pairs_stands_on_a_box(tmp_path):
    walker = tiny.load_character(tmp_path)
    model = _among(walker, obstacles.box((0.0, 0.0), (2.0, 2.0), 0.4))
    data = mujoco.MjData(model)
    data.qpos[:] = tiny.standing()[0]
    data.qpos[2] = 0.95
    for _ in range(60):
        mujoco.mj_step(model, data)
    feet = [data.geom_xpos[g, 2] for g in range(model.ngeom) if model.geom_size[g, 0] == 0.12]
    assert len(feet) == 2 and min(feet) > 0.4


def test_the_humanoid_lies_on_a_box_it_falls_on(who: Character):
    model = _among(who, obstacles.box((0.0, 0.0), (4.0, 4.0), 0.6))
    data = mujoco.MjData(model)
    data.qpos[2] += 0.65
    data.qvel[4] = 3.0  # rad/s, forward
    for _ in range(300):
        mujoco.mj_step(model, data)
    assert data.xpos[1:, 2].min() > 0.6 and data.qpos[2] < 1.0


def test_factors_change_heights_and_places(who: Character):
    spec = TaskSpec(
        (
            Parameter("height", (0.5, 2.0), condition=obstacles.box((1, 0), (1, 1), 0.4, "one")),
            Parameter("place", (1.0, 3.0), condition=obstacles.moved("two", (0.5, 0.25))),
            Parameter("step", (-1.0, 1.0), condition=obstacles.step("two", "three")),
        ),
        scenery=(
            obstacles.box((2, 0), (1, 1), 0.0, "two"),
            obstacles.box((3, 0), (1, 1), 0.0, "three"),
        ),
    )
    among = task.placed(spec, who)
    for a, tops, x in (
        ((0.0, 0.0, 0.0), (0.2, 1.0, -1.0), 2.0),
        ((1.0, 0.5, 0.5), (0.8, -1.0, -1.0), 2.5),
        ((1.0, 1.0, 1.0), (0.8, -1.0, 1.0), 3.0),
    ):
        model = task.variant(spec, among, np.array(a)).model
        found = [model.geom(name) for name in ("one", "two", "three")]
        np.testing.assert_allclose([g.pos[2] + g.size[2] for g in found], tops, atol=1e-9)
        assert found[1].pos[0] == pytest.approx(x)
        assert found[1].pos[1] == pytest.approx(0.5 * (x - 2.0))
        assert all(g.pos[2] - g.size[2] < -0.5 for g in found)


def test_a_bar_is_solid_but_for_the_hands_that_hold_it(who: Character):
    grip = Grip(("left_wrist", "right_wrist"), 0.3, 0.6)
    held, loose = (_among(who, obstacles.bar((0.5, 0.0), 2.0, grip=x)) for x in (grip, None))
    everything = _partners(loose, "floor")
    assert _partners(loose, "bar") == everything
    hands = {"left_wrist", "right_wrist"}
    assert _partners(held, "bar") == [x for x in everything if x not in hands]
    geom = held.geom("bar")
    assert geom.pos == pytest.approx([0.5, 0.0, 2.0]) and geom.size[0] == 0.015
    np.testing.assert_allclose(np.abs(_turned(held, "bar")[:, 2]), [0, 1, 0], atol=1e-9)


def _turned(model: mujoco.MjModel, name: str) -> np.ndarray:
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, model.geom(name).quat)
    return frame.reshape(3, 3)


def test_bars_name_the_geoms_of_those_who_do_not(tmp_path):
    walker = tiny.load_character(tmp_path)
    model = _among(walker, obstacles.bar((0.5, 0.0), 2.0))
    assert _partners(model, "bar") == ["left_leg_1", "pelvis_0", "right_leg_1", "torso_0"]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: obstacles.box((0, 0), (0.1, 0.0), 1.0), "box box: size is 0.1, 0: give 0.001 to"),
        (lambda: obstacles.box((0, 0), (1, 1), -1.0, "b"), "box b: height is -1: give 0 to 100"),
        (lambda: obstacles.box((np.nan, 0), (1, 1), 1.0), "box box: center is nan, 0: give -100"),
        (lambda: obstacles.bar((0, 0), 0.0), "bar bar: height, length, radius is 0, 1.2, 0.015"),
        (lambda: obstacles.moved("b", (np.inf, 0)), "object b: by is inf, 0: give -100 to 100"),
    ],
)
def test_numbers_out_of_range(make, message: str):
    with pytest.raises(UserError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_names_that_do_not_fit(who: Character):
    box = obstacles.box((0, 0), (1, 1), 0.5)
    for objects, message in (
        ((box, box), "object box: there is another geom of that name"),
        ((box, obstacles.box((0, 0), (1, 1), 0.5, "chest")), "object chest: there is another"),
        ((box, obstacles.moved("boks", (1, 0))), "unknown object 'boks': choose one of box"),
        ((obstacles.step("box", "two"),), "unknown object 'box': choose one of none, as"),
        ((obstacles.bar((0, 0), 2, grip=Grip(("hand",), 0, 1)),), "unknown body of humanoid34 'ha"),
    ):
        with pytest.raises(UserError, match=message):
            _among(who, *objects)


def _whole(name: str) -> tuple[TaskSpec, Character]:
    recipe = recipes.find(name)
    assert recipe.task is not None
    return recipe.task, task.placed(recipe.task, character.load(recipe.character))


@pytest.mark.parametrize("name", FAMILIES)
def test_recipes_compile_at_the_ends_of_their_ranges_in_equal_sizes(name: str):
    spec, who = _whole(name)
    count = len(spec.free)
    corners = [np.array([i >> bit & 1 for bit in range(count)]) for i in range(2**count)]
    models = [task.variant(spec, who, a).model for a in corners]
    base.check(models)
    assert len({mujoco.mj_sizeModel(model) for model in models}) == 1
    tops = np.array([model.geom_pos[:, 2] for model in models])
    assert (tops != tops[0]).any()


def _reference(spec: TaskSpec) -> np.ndarray:
    """Returns the place of the clip in the ranges: its own height, on level ground."""
    return np.array([task.normalised(p, 1.0 if p.relative else 0.0) for p in spec.free])


@pytest.mark.parametrize("name", [*FAMILIES, *PLAIN])
def test_the_clip_touches_its_objects_only_where_it_should(name: str, request):
    """No limb is in an object by more than 5 mm, and hands are on the wall while they prop."""
    recipe = recipes.find(name)
    if recipe.clip == "jump":
        request.getfixturevalue("deepmimic")
    spec, who = _whole(name)
    model = task.variant(spec, who, _reference(spec)).model
    qpos, data = retarget.retarget(who, clip.load(recipe.clip)), mujoco.MjData(model)
    touching: dict[str, list[int]] = {}
    for i, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            names = {model.geom(int(g)).name for g in contact.geom}
            bodies = [model.geom_bodyid[g] for g in contact.geom]
            if 0 in bodies and "floor" not in names:
                assert contact.dist > -0.005, (i, names)
                (limb,) = names & set(who.body_names)
                touching.setdefault(limb, []).append(i)
    if recipe.clip != "wall_jump":
        assert not touching
        return
    assert set(touching) <= {"left_wrist", "right_wrist"}
    for frames in touching.values():  # at 30 Hz; the hands are on it from 1.3 to 1.53 s
        assert 39 <= min(frames) and max(frames) <= 46


def test_the_clips_need_no_more_room(deepmimic):
    """At the upper ends of the ranges, obstacles are in the way of the clips as they are."""
    for name in ("obstacle_jump_family", "wall_jump_family", "swing_family"):
        spec, who = _whole(name)
        model = task.variant(spec, who, np.ones(1)).model
        data, deepest = mujoco.MjData(model), 0.0
        for pose in retarget.retarget(who, clip.load(recipes.find(name).clip)):
            data.qpos[:] = pose
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            fixed = (model.geom_bodyid[data.contact.geom] == 0).any(1)
            fixed &= (data.contact.geom != model.geom("floor").id).all(1)
            deepest = min(deepest, data.contact.dist[fixed].min(initial=0.0))
        assert deepest < -0.05, name
