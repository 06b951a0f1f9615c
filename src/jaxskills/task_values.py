# SPDX-License-Identifier: Apache-2.0
"""Task parameters as a person types them: `rotation=1.6`, or several values for a grid.

    energy=1.2 gravity=0.5          one performance
    energy=0.8,1.3,1.8              three side by side
    energy=0.8,1.3,1.8 gravity=0.5,1    two rows of three

A parameter that is not named has the reference's own value.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxskills.env import task as task_lib
from jaxskills.env.task import TaskSpec
from jaxskills.errors import UserError, unknown

_MOST = 25  # performances in a grid


class Wanted(NamedTuple):
    """Performances in rows and columns, each a normalised task parameter with its name."""

    a: np.ndarray  # [R, C, P]
    names: tuple[tuple[str, ...], ...]  # [R][C]


def parse(spec: TaskSpec, reference: np.ndarray, words: Sequence[str]) -> Wanted:
    """Returns what words like `rotation=1.6` or `rotation=0.8,1.6,2.4` ask for.

    The first parameter with several values goes across, the second one down.

    Args:
      spec: of the family.
      reference: `[P]` normalised parameter of the reference.
      words: NAME=VALUE, or NAME=VALUE,VALUE... of at most two parameters.

    Raises:
      UserError: an unknown or repeated name, no number, a value out of range, too many values.
    """
    values: dict[str, list[float]] = {}
    for word in words:
        name, equals, text = word.partition("=")
        names = [p.name for p in spec.free]
        if name not in names:
            raise unknown("task parameter", name, names)
        if name in values:
            raise UserError(f"task parameter {name} comes twice: give all its values in one word")
        try:
            values[name] = [float(part) for part in text.split(",")]
        except ValueError:
            raise UserError(
                f"task parameter {name} is '{text}': give it a number, as in {name}=1.2, or several"
                f" as in {name}=1,1.2"
            ) from None
    return across(spec, reference, values)


def spread(spec: TaskSpec, reference: np.ndarray, count: int = 3) -> Wanted:
    """Returns a grid over all the range of the first two parameters, the others as the reference.

    With one parameter it is a row.
    """
    ends = {p.name: np.linspace(*p.range, count).tolist() for p in spec.free[:2]}
    return across(spec, reference, ends)


def across(spec: TaskSpec, reference: np.ndarray, values: dict[str, list[float]]) -> Wanted:
    """Returns the grid of values by parameter, at most two of which have several.

    Raises:
      UserError: a value out of range, too many values.
    """
    several = [name for name, of in values.items() if len(of) > 1]
    if len(several) > 2:
        raise UserError(
            f"task parameters {', '.join(several)} have several values: give one or two of them"
            " several, the others one each"
        )
    columns, rows = ([*several, "", ""])[:2]
    if np.prod([len(of) for of in values.values()]) > _MOST:
        raise UserError(f"a grid of more than {_MOST} performances: give fewer values")
    grid, names = [], []
    for down in values.get(rows, [None]):
        for right in values.get(columns, [None]):
            one = {name: of[0] for name, of in values.items()}
            one |= {name: x for name, x in ((columns, right), (rows, down)) if x is not None}
            grid.append(_filled(spec, reference, one))
            names.append(", ".join(f"{name} {x:.3g}" for name, x in one.items()) or "reference")
    shape = len(values.get(rows, [None])), len(values.get(columns, [None]))
    a = np.reshape(grid, (*shape, len(spec.free))).astype(np.float32)
    told = tuple(tuple(names[i : i + shape[1]]) for i in range(0, len(names), shape[1]))
    return Wanted(a, told)


def _filled(spec: TaskSpec, reference: np.ndarray, values: dict[str, float]) -> np.ndarray:
    """Returns the normalised parameter `[P]`; the reference's own may lie outside the ranges."""
    middle = {p.name: p.range[0] for p in spec.free}
    found = task_lib.from_units(spec, middle | values)
    named = np.array([p.name in values for p in spec.free], bool)
    return np.where(named, found, reference)
