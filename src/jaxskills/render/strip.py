# SPDX-License-Identifier: Apache-2.0
"""A film strip: moments of a motion side by side in one wide image, seen from the right."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxskills.render import stage
from jaxskills.render.take import Take, lookat
from jaxskills.render.video import GREEN, INK

_PAPER = (255, 255, 255)
_GAP = 3  # pixels between panels
_FINE = 2  # drawn this much larger, then shrunk, for smooth edges

# Nearly a side view through a long lens, so that panels fit together: degrees.
_AZIMUTH, _ELEVATION, _FOVY = 105.0, -8.0, 12.0

_ASIDE, _BELOW = 0.08, 0.1  # free space at the sides and below, in statures
_TEXT = 0.11  # size of the letters, of the width of a panel
_LEADING = 1.3  # between two lines, in letters
_GREEN = "green: reference"


@dataclasses.dataclass(frozen=True, eq=False)
class _Row:
    """One line of N panels; the camera goes with `centre`."""

    solid: np.ndarray | None  # [N, nq]
    ghost: np.ndarray | None  # [N, nq]
    centre: np.ndarray  # [N, 3] m
    name: str
    take: Take


def draw(
    takes: Sequence[Take], width: int, seconds: float, panels: int, overlay: bool
) -> Image.Image:
    """Returns the strip; its height follows from the motion.

    Args:
      takes: what is shown, one below the other at the same times and the same size.
      width: of the strip in pixels, a few less where panels do not come out even.
      seconds: time between the first and the last panel, less if all takes are shorter.
      panels: how many, fewer if the longest take has fewer poses.
      overlay: draw the reference as a ghost in the row of the simulation, else in a row above.
    """
    longest = max(takes, key=lambda take: len(take.qpos))
    count = min(panels, len(longest.qpos))
    last = min(seconds * longest.fps, len(longest.qpos) - 1)
    moments = np.round(np.linspace(0, last, count)).astype(int)
    labels = [longest.labels[i] for i in moments]
    rows = [row for take in takes for row in _rows(take, moments, overlay)]
    lens = stage.Lens(float(np.degrees(takes[0].heading)) + _AZIMUTH, _ELEVATION, 1.0, _FOVY)
    aside, low, high = _extent(rows, lens)
    body = max(take.body for take in takes)
    aside += _ASIDE * body
    low -= _BELOW * body
    lines = 1 + max(len(_lines(row.name)) for row in rows)
    high += 2 * aside * _TEXT * (0.5 + _LEADING * lines)
    lens = dataclasses.replace(lens, distance=(high - low) / 2 / np.tan(np.radians(_FOVY / 2)))
    wide = max((width - (count - 1) * _GAP) // count, 1)
    tall = round(wide * (high - low) / (2 * aside))
    strip = Image.new(
        "RGB", (count * (wide + _GAP) - _GAP, len(rows) * (tall + _GAP) - _GAP), _PAPER
    )
    for take, group in itertools.groupby(enumerate(rows), key=lambda row: row[1].take):
        model, forward = take.character.model, take.character.forward
        with stage.opened(model, forward, lens, _FINE * wide, _FINE * tall) as studio:
            for (down, row), (i, label) in itertools.product(group, enumerate(labels)):
                point = np.array([*row.centre[i, :2], (low + high) / 2])
                poses = (None if poses is None else poses[i] for poses in (row.solid, row.ghost))
                panel = Image.fromarray(stage.picture(studio, point, *poses)).reduce(_FINE)
                _write(panel, label, row.name if i == 0 else "")
                strip.paste(panel, (i * (wide + _GAP), down * (tall + _GAP)))
    return strip


def _rows(take: Take, moments: np.ndarray, overlay: bool) -> list[_Row]:
    moments = np.minimum(moments, len(take.qpos) - 1)  # who ends sooner waits in its last pose
    solid, centre = take.qpos[moments], lookat(take, take.qpos)[moments]
    if take.reference is None:
        return [_Row(solid, None, centre, take.name, take)]
    ghost = take.reference[moments]
    if overlay:
        return [_Row(solid, ghost, centre, take.name or _GREEN, take)]
    its_centre = lookat(take, take.reference)[moments]
    names = "reference", "simulation"
    return [
        _Row(None, ghost, its_centre, names[0], take),
        _Row(solid, None, centre, names[1], take),
    ]


def _extent(rows: list[_Row], lens: stage.Lens) -> tuple[float, float, float]:
    """Returns in m how far the poses reach from the centre sideways, how low and how high."""
    aside, low, high = [0.0], [], []
    for row in rows:
        model = row.take.character.model
        for poses in (row.solid, row.ghost):
            for pose, centre in zip([] if poses is None else poses, row.centre, strict=False):
                across = np.array(stage.reach(model, pose, lens.right)) - centre @ lens.right
                bottom, top = stage.reach(model, pose, stage.UP)
                aside.append(np.abs(across).max())
                low.append(bottom)
                high.append(top)
    return max(aside), min(low), max(high)


def _write(panel: Image.Image, label: str, name: str) -> None:
    size = max(_TEXT * panel.width, 9.0)
    font, margin = ImageFont.load_default(size), size / 2
    pen = ImageDraw.Draw(panel)
    pen.text((margin, margin), label, INK, font)
    colour = GREEN if name in ("reference", _GREEN) else INK
    for i, line in enumerate(_lines(name)):
        pen.text((margin, margin + (1 + i) * _LEADING * size), line, colour, font)


def _lines(name: str) -> list[str]:
    """Returns what a row is called, by lines: a panel is too narrow for several parameters."""
    return name.split(", ") if name else []
