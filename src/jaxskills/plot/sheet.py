# SPDX-License-Identifier: Apache-2.0
"""What all pictures share: colours, labels, legends, and which rows are worth their place."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from jaxskills.errors import unknown

FORMATS = (".png", ".pdf", ".svg")

BLUE, GREEN, RED, ORANGE, GREY = "#3568a5", "#2a8f52", "#c23b33", "#d9822b", "#8a9099"
# Told apart in print and by the colour-blind; more causes than this are shown as one.
CYCLE = (BLUE, ORANGE, "#5aa897", "#b0507f", "#7c64b5", "#a8923a")

BINS = 40  # of phase
PHASE = "phase (share of a cycle)"


def admitted(path: str | Path) -> Path:
    """Returns the path of a picture.

    Raises:
      UserError: its suffix is none of `FORMATS`.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise unknown("picture format", path.suffix, FORMATS)
    return path


def finish(axes: Axes, title: str, x: str, y: str) -> None:
    """Gives axes their title and labels, and the look of all of them."""
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e3e5e8", linewidth=0.6)
    axes.set_axisbelow(True)


def legend_beside(axes: Axes, reverse: bool = False) -> None:
    """Puts the legend to the right of the axes."""
    beside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
    axes.legend(fontsize=8, frameon=False, reverse=reverse, **beside)


def say(axes: Axes, text: str) -> None:
    """Writes a remark where a picture would be."""
    middle = {"transform": axes.transAxes, "ha": "center", "va": "center"}
    axes.text(0.5, 0.5, text, fontsize=11, color=GREY, **middle)


def foremost(rows: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Returns the `count` rows with the largest sums, then the sum of the others; no empty rows."""
    ordered = sorted((n for n in rows if rows[n].sum() > 0), key=lambda n: -rows[n].sum())
    kept = {name: rows[name] for name in ordered[:count]}
    others = ordered[count:]
    if others:
        kept[f"{len(others)} others"] = np.sum([rows[name] for name in others], axis=0)
    return kept


def binned(phase: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Returns of phases `[N]` the bin of each `[N]`, and the bins that are not empty, ascending."""
    place = np.clip((np.asarray(phase) * bins).astype(int), 0, bins - 1)
    return place, np.unique(place)
