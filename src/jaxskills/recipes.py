# SPDX-License-Identifier: Apache-2.0
"""Recipes: what to learn, by name. A recipe is a Python file that defines `RECIPE`."""

import dataclasses
import runpy
from pathlib import Path
from typing import TYPE_CHECKING

from jaxskills import clip
from jaxskills.errors import UserError, unknown
from jaxskills.paths import shipped

if TYPE_CHECKING:
    from jaxskills.env.task import TaskSpec
    from jaxskills.trainer import TrainConfig


@dataclasses.dataclass(frozen=True)
class Recipe:
    """One skill: a clip, a character, and how to train."""

    name: str
    clip: str  # the name of a shipped or DeepMimic clip, or a path
    character: str = "humanoid34"  # the name of a shipped character, or the path of an MJCF file
    config: "TrainConfig | None" = None  # None: the defaults
    task: "TaskSpec | None" = None  # what a family of skills varies in; None: one skill
    note: str = ""  # where it comes from, what is particular about it
    source: str = ""  # where `find` found it: the shipped name, or the file


def names() -> list[str]:
    """Returns the names of the shipped recipes, sorted."""
    return sorted(path.stem for path in _folder().glob("[!_]*.py"))


def find(skill: str) -> Recipe:
    """Returns the recipe of that name or file, or the default one for that clip.

    Raises:
      UserError: neither a recipe nor a clip, by name or as a file.
    """
    path = Path(skill)
    if skill in names():
        return dataclasses.replace(_read(_folder() / f"{skill}.py"), source=skill)
    if path.suffix == ".py":
        if not path.is_file():
            raise UserError(f"recipe file '{skill}' does not exist")
        return dataclasses.replace(_read(path), source=str(path.absolute()))
    if path.suffix or path.exists():
        return Recipe(path.stem, str(clip.find(skill)))
    if skill in clip.available():
        return Recipe(path.name, skill)
    raise unknown("skill", skill, [*names(), "a name of `jaxskills clips list`, a clip file"])


def task(skill: str) -> "TaskSpec":
    """Returns what a family of skills varies in, by the recipe's name or file.

    Raises:
      UserError: no such recipe, or it is of one skill.
    """
    found = find(skill).task
    if found is None:
        raise UserError(f"task is {skill}: that recipe has no task, so it is no family")
    return found


def _folder() -> Path:
    return shipped("experiments/skills")


def _read(path: Path) -> Recipe:
    recipe = runpy.run_path(str(path)).get("RECIPE")
    if not isinstance(recipe, Recipe):
        raise UserError(f"recipe file '{path}' defines no RECIPE: set it to a jaxskills.Recipe")
    return recipe
