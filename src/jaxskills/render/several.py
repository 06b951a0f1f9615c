# SPDX-License-Identifier: Apache-2.0
"""Several performances in one film, side by side, each with its own character."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from PIL import Image

from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.render import video
from jaxskills.render.take import Take, checked

_WIDEST = 1.8  # times as wide as the film of one performance
_CELL = 480, 360  # pixels at most
_PAPER = (255, 255, 255)


@dataclasses.dataclass(frozen=True, eq=False)
class Cell:
    """One performance."""

    character: Character
    qpos: np.ndarray  # [T, nq] simulated poses
    reference_qpos: np.ndarray | None  # [T, nq] at the same times
    name: str  # what is special about it


def takes(cells: Sequence[Sequence[Cell]], fps: float) -> list[list[Take]]:
    """Returns the takes of cells, all seen from where the first one is seen.

    Raises:
      UserError: no cells, or what `take.checked` refuses.
    """
    if not cells or not all(cells):
        raise UserError("a grid of no performances: give one or more in each row")
    rows = [[_take(cell, fps) for cell in row] for row in cells]
    heading = rows[0][0].heading
    return [[dataclasses.replace(take, heading=heading) for take in row] for row in rows]


def _take(cell: Cell, fps: float) -> Take:
    take = checked(cell.character, cell.qpos, cell.reference_qpos, None, fps)
    return dataclasses.replace(take, name=cell.name)


def cell_size(columns: int, width: int) -> tuple[int, int]:
    """Returns width and height in pixels of a cell, for films of one that are `width` wide."""
    wide = min(_CELL[0], round(_WIDEST * width / columns))
    tall = round(wide * _CELL[1] / _CELL[0])
    return wide - wide % 2, tall - tall % 2


def frames(
    rows: Sequence[Sequence[Take]], cell: tuple[int, int], step: int = 1
) -> Iterator[Image.Image]:
    """Yields the pictures of a film until the last performance is over.

    Args:
      rows: of takes.
      cell: width and height of each in pixels.
      step: leave out all poses but every `step`-th.
    """
    films = {
        (down, right): video.frames(take, cell, False, step, legend=down == right == 0)
        for down, row in enumerate(rows)
        for right, take in enumerate(row)
    }
    longest = max(len(take.qpos) for row in rows for take in row)
    page = Image.new("RGB", (max(map(len, rows)) * cell[0], len(rows) * cell[1]), _PAPER)
    try:
        for _ in range(0, longest, step):
            for (down, right), film in films.items():
                picture = next(film, None)
                if picture is not None:
                    page.paste(picture, (right * cell[0], down * cell[1]))
            yield page.copy()
    finally:
        for film in films.values():  # each has graphics memory of its own
            film.close()
