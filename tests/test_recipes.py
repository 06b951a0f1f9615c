# SPDX-License-Identifier: Apache-2.0
"""Recipes are found by name, by file, or made for a clip."""

from pathlib import Path

import pytest

from jaxskills import recipes
from jaxskills.errors import UserError
from jaxskills.recipes import Recipe


@pytest.mark.parametrize("name", recipes.names())
def test_shipped_recipes_are_named_after_their_file(name: str):
    recipe = recipes.find(name)
    assert (recipe.name, bool(recipe.note)) == (name, True)


def test_the_walk_and_the_run_are_there():
    assert {"walk", "run"} <= set(recipes.names())


def test_a_clip_file_gets_the_default_settings(tmp_path: Path):
    file = tmp_path / "my hop.bvh"
    file.touch()
    assert recipes.find(str(file)) == Recipe("my hop", str(file))


def test_a_clip_name_gets_the_default_settings(deepmimic: Path):
    assert recipes.find("spin") == Recipe("spin", "spin")
    assert recipes.find("walker/turn_left0") == Recipe("turn_left0", "walker/turn_left0")


def test_a_recipe_file(tmp_path: Path):
    file = tmp_path / "mine.py"
    file.write_text(
        "from jaxskills.recipes import Recipe\n"
        "RECIPE = Recipe('mine', 'walk', character='me.xml')\n"
    )
    assert recipes.find(str(file)) == Recipe("mine", "walk", character="me.xml")


@pytest.mark.parametrize(
    ("skill", "message"),
    [
        ("wlak", "unknown skill 'wlak': choose one of run, walk, "),
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
