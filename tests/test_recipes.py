# SPDX-License-Identifier: Apache-2.0
"""Recipes are found by name, by file, or made for a clip; the shipped ones fit their clips."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from jaxskills import character, clip, commands, families, recipes, retarget, trainer
from jaxskills.errors import UserError
from jaxskills.recipes import Recipe


@pytest.mark.parametrize("name", recipes.names())
def test_shipped_recipes_are_named_after_their_file(name: str):
    recipe = recipes.find(name)
    assert (recipe.name, bool(recipe.note)) == (name, True)


@pytest.mark.parametrize("name", recipes.names())
def test_shipped_recipes_fit_their_clips(name: str):
    """The heading axis stays off the vertical, and what is in the floor may touch it."""
    config = commands.settings(recipes.find(name))
    trainer.validate(config)
    try:
        motion = clip.load(config.clip)
    except UserError as missing:
        pytest.skip(str(missing))
    who = character.load(config.character)
    side = config.env.heading == "lateral"
    axis = np.cross([0.0, 0.0, 1.0], who.forward) if side else who.forward
    grounded = who.ground if config.env.may_touch is None else config.env.may_touch
    allowed = who.bodies(grounded)
    model, data = who.model, mujoco.MjData(who.model)
    floor, pairs = model.geom("floor").id, zip(model.pair_geom1, model.pair_geom2, strict=True)
    geoms = [b if a == floor else a for a, b in pairs if floor in (a, b)]
    others = [g for g in geoms if model.geom_bodyid[g] - 1 not in allowed]
    assert len(others) < len(geoms)
    for pose in retarget.retarget(who, motion)[::2]:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        assert np.linalg.norm((data.xmat[1].reshape(3, 3) @ axis)[:2]) > 0.4
        for geom in others:
            assert mujoco.mj_geomDistance(model, data, floor, geom, 1.0, None) > -0.01


@pytest.mark.parametrize("name", ["atlas_walk", "sparse_backward_jog", "spin"])
def test_shipped_recipes_make_trainers(name: str, deepmimic: Path):
    made = trainer.make(commands.settings(recipes.find(name)))
    assert made.motion.loop and made.env.action_size == len(made.character.actuated)


def test_the_walk_and_the_run_are_there():
    assert {"walk", "run"} <= set(recipes.names())


def test_a_clip_file_gets_the_default_settings(tmp_path: Path):
    file = tmp_path / "my hop.bvh"
    file.touch()
    assert recipes.find(str(file)) == Recipe("my hop", str(file))


def test_a_clip_name_gets_the_default_settings(deepmimic: Path):
    assert recipes.find("dance_b") == Recipe("dance_b", "dance_b")
    assert recipes.find("walker/turn_left0") == Recipe("turn_left0", "walker/turn_left0")


def test_a_recipe_file(tmp_path: Path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from jaxskills.recipes import Recipe\n"
        "RECIPE = Recipe('mine', 'walk', character='me.xml')\n"
    )
    expected = Recipe("mine", "walk", character="me.xml", source=str(file))
    assert recipes.find(str(file)) == expected


def test_the_task_of_a_family_by_name_and_by_file(tmp_path: Path):
    assert [p.name for p in recipes.task("pivot_family").parameters] == ["rotation"]
    file = tmp_path / "mine.py"
    file.write_text(
        "from jaxskills.recipes import Recipe\n"
        "from jaxskills.env.task import TaskSpec\n"
        "RECIPE = Recipe('mine', 'walk', task=TaskSpec())\n"
    )
    assert recipes.task(str(file)).parameters == ()
    with pytest.raises(UserError, match="task is walk: that recipe has no task"):
        recipes.task("walk")


def test_the_recipe_of_the_readme_is_a_family(tmp_path: Path, deepmimic: Path):
    readme = Path(__file__).parents[1] / "README.md"
    text = readme.read_text().split("```python\n")
    (code,) = [part.split("```")[0] for part in text if "TaskSpec" in part]
    file = tmp_path / "hurdle.py"
    file.write_text(code)
    config = commands.settings(recipes.find(str(file)))
    spec = recipes.task(config.task)
    own = families.parts(config, spec)
    np.testing.assert_allclose(own.task.reference, [1.0], atol=0.15)  # m, the jump of the clip
    np.testing.assert_allclose(own.task.base, [0.2, 0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("skill", "message"),
    [
        ("wlak", f"unknown skill 'wlak': choose one of {', '.join(recipes.names())}, a name of "),
        ("none.py", "recipe file 'none.py' does not exist"),
        ("none.bvh", "clip 'none.bvh' does not exist"),
    ],
)
def test_what_is_not_there(skill: str, message: str):
    with pytest.raises(UserError) as raised:
        recipes.find(skill)
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)


def test_a_recipe_file_must_define_one(tmp_path: Path):
    file = tmp_path / "empty.py"
    file.write_text("RECIPE = 3\n")
    with pytest.raises(UserError, match="empty.py' defines no RECIPE"):
        recipes.find(str(file))
