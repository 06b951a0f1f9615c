# SPDX-License-Identifier: Apache-2.0
"""Films and film strips from stored poses: the simulation, and the reference as a green ghost."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from jaxskills.character import Character
from jaxskills.errors import UserError, unknown
from jaxskills.render import several, strip, video
from jaxskills.render.several import Cell
from jaxskills.render.take import checked

__all__ = ["FORMATS", "Cell", "film", "grid"]

# Suffix to width and height in pixels; of a strip only the width is given.
FORMATS = {".mp4": (800, 450), ".gif": (480, 270), ".png": (1800, 0)}

_STRIP_SECONDS = 4.0  # of a clip without cycles


def film(
    character: Character,
    qpos: np.ndarray,
    reference_qpos: np.ndarray | None,
    path: str | Path,
    *,
    fps: float = 30.0,
    size: tuple[int, int] | None = None,
    overlay: bool = False,
    labels: Sequence[str] | None = None,
    cycle: float | None = None,
    panels: int = 12,
) -> Path:
    """Writes a film (.mp4, .gif) or a film strip (.png) and returns its path.

    The camera follows the simulation from its right. The ghost goes at its far side, as much ahead
    or behind as the reference is, but at most a third of a stature, so that it stays in sight; with
    `overlay` it is exactly where the reference is. In a strip it has the upper row, with `overlay`
    the same one. A pose that is not finite ends the film.

    Args:
      character: who moves.
      qpos: [T, nq] simulated poses.
      reference_qpos: [T, nq] reference poses at the same times, or None.
      path: file to write; its suffix decides what.
      fps: poses per s. An .mp4 shows all of them in real time, a .gif at most 15 per s.
      size: width and height in pixels, else `FORMATS`; a strip's height follows from the motion.
      overlay: draw the ghost where the reference is instead of beside the simulation.
      labels: [T] text on each picture; None shows the time.
      cycle: s, duration of one cycle; a strip shows two of them, or 4 s if it is None.
      panels: pictures in a strip.

    Raises:
      UserError: another suffix, arrays of another shape, nothing to render with.
    """
    path, suffix = _admitted(path)
    width, height = size or FORMATS[suffix]
    if width < 16 or panels < 1 or (height < 16 and suffix != ".png"):
        raise UserError(
            f"a film of {width} x {height} pixels, {panels} panels: give at least 16, 1"
        )
    take = checked(character, qpos, reference_qpos, labels, fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    if suffix == ".png":
        seconds = 2 * cycle if cycle else _STRIP_SECONDS
        strip.draw([take], width, seconds, panels, overlay).save(path)
    else:
        step = video.gif_step(fps) if suffix == ".gif" else 1
        even = width - width % 2, height - height % 2
        _write(path, video.frames(take, even, overlay, step), even, fps / step)
    return path


def grid(
    cells: Sequence[Sequence[Cell]],
    path: str | Path,
    *,
    fps: float = 30.0,
    size: tuple[int, int] | None = None,
    panels: int = 12,
) -> Path:
    """Writes a film of several performances side by side, or their film strips one below the other.

    All begin together; who ends sooner waits in its last pose. Every one is drawn as the character
    that it is given with, so bodies and objects may differ. In a strip the ghost is drawn where the
    reference is.

    Args:
      cells: rows, from left to right.
      path: see `film`.
      fps: poses per s.
      size: width and height in pixels of one cell (of a whole strip), else as large as fits.
      panels: pictures in a strip.

    Raises:
      UserError: as `film`, or no cells.
    """
    path, suffix = _admitted(path)
    takes = several.takes(cells, fps)
    path.parent.mkdir(parents=True, exist_ok=True)
    if suffix == ".png":
        flat = [take for row in takes for take in row]
        width = (size or FORMATS[suffix])[0]
        longest = max(len(take.qpos) for take in flat) / fps
        strip.draw(flat, width, longest, panels, overlay=True).save(path)
        return path
    columns = max(len(row) for row in takes)
    cell = size or several.cell_size(columns, FORMATS[suffix][0])
    step = video.gif_step(fps) if suffix == ".gif" else 1
    whole = columns * cell[0], len(takes) * cell[1]
    _write(path, several.frames(takes, cell, step), whole, fps / step)
    return path


def _admitted(path: str | Path) -> tuple[Path, str]:
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise unknown("film format", path.suffix, FORMATS)
    return path, suffix


def _write(path: Path, pictures: Iterator[Image.Image], size: tuple[int, int], fps: float) -> None:
    if path.suffix.lower() == ".gif":
        video.write_gif(path, pictures, fps)
    else:
        video.write_mp4(path, pictures, size, fps)
