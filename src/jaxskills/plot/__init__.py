# SPDX-License-Identifier: Apache-2.0
"""Pictures of a training: how it went, where its controller goes within its bounds.

Everything is drawn on plain matplotlib figures, without pyplot: no window, no global state.
Phases are shares of a cycle, 0 to 1.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxskills.plot import starts
from jaxskills.plot.sheet import FORMATS, admitted
from jaxskills.plot.starts import Evolved
from jaxskills.plot.states import com_height, endings, margins, regions, regions_height
from jaxskills.plot.training import causes, learning_curve, training_endings

__all__ = [
    "Evolved",
    "FORMATS",
    "Played",
    "causes",
    "com_height",
    "endings",
    "figure",
    "learning_curve",
    "margins",
    "regions",
    "training_endings",
]

_ROW = 3.4  # inches
_TITLE = 0.6


@dataclasses.dataclass(frozen=True, eq=False)
class Played:
    """N states of a trained controller. A margin is 1 on the reference and 0 at the bound."""

    phase: np.ndarray  # [N]
    height: np.ndarray  # [N] m, of the CoM
    reference_phase: np.ndarray  # [R]
    reference_height: np.ndarray  # [R] m, of the CoM
    bound: np.ndarray  # [R] m, size of the bound on the height of the CoM
    margins: Mapping[str, np.ndarray]  # bound -> [N]
    endings: Mapping[str, np.ndarray]  # bound -> [P] episodes it ended in each P-th of the cycle


def figure(
    path: str | Path,
    title: str,
    metrics: Sequence[Mapping[str, Any]],
    played: Played | None,
    evolved: Evolved | None = None,
) -> Path:
    """Writes the page with all the pictures and returns its path.

    Args:
      path: .png, .pdf or .svg.
      title: what was learnt.
      metrics: lines of metrics.jsonl.
      played: states of the trained controller; None leaves their pictures out.
      evolved: starts of a run whose starts evolve.

    Raises:
      UserError: another suffix, or metrics without lines or without what each line must have.
    """
    path = admitted(path)
    heights = [_ROW]
    if played is not None:
        heights += [_ROW, _ROW, regions_height(len(played.margins))]
    if evolved is not None:
        heights += [_ROW]
    page = Figure(figsize=(11.0, _TITLE + sum(heights)), dpi=150, layout="constrained")
    page.suptitle(title, fontsize=14, fontweight="bold")
    # Rows of their own, so that long names in one do not narrow the others.
    rows = page.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    left, right = rows[0].subplots(1, 2)
    learning_curve(metrics, left)
    causes(metrics, right)
    if played is not None:
        left, right = rows[1].subplots(1, 2)
        com_height(
            played.phase,
            played.height,
            played.reference_phase,
            played.reference_height,
            played.bound,
            left,
        )
        margins(played.phase, played.margins, right)
        left, right = rows[2].subplots(1, 2)
        training_endings(metrics, left)
        endings(played.endings, right)
        regions(played.phase, played.margins, rows[3])
    if evolved is not None:
        left, right = rows[-1].subplots(1, 2)
        starts.component(evolved, left)
        starts.distance(evolved, right)
    path.parent.mkdir(parents=True, exist_ok=True)
    page.savefig(path)
    return path
