# SPDX-License-Identifier: Apache-2.0
"""How far evolved starts have moved from the reference (SB 4.3.2, fig. 13)."""

import dataclasses

import numpy as np
from matplotlib.axes import Axes

from jaxskills.plot.sheet import BINS, BLUE, GREEN, PHASE, binned, finish

_DOTS = {"s": 2.0, "alpha": 0.35, "linewidths": 0, "rasterized": True}


@dataclasses.dataclass(frozen=True, eq=False)
class Evolved:
    """N evolved starts beside R states of the reference, as the coordinates of bodies in m."""

    phase: np.ndarray  # [N]
    places: np.ndarray  # [N, C]
    at_phase: np.ndarray  # [N, C] of the reference at the same phases
    reference_phase: np.ndarray  # [R] increasing
    reference: np.ndarray  # [R, C]


def component(evolved: Evolved, axes: Axes) -> None:
    """Draws the first principal component of starts and reference over phase, as SB fig. 13.

    SB takes locally linear embeddings; this is the plain component, whose unit is m.
    """
    everything = np.concatenate((evolved.places, evolved.reference))
    middle = everything.mean(0)
    _, spread, directions = np.linalg.svd(everything - middle, full_matrices=False)
    first = directions[0] * np.sign(directions[0][np.abs(directions[0]).argmax()])
    share = spread[0] ** 2 / max(float(np.sum(spread**2)), 1e-12)
    starts, reference = ((x - middle) @ first for x in (evolved.places, evolved.reference))
    axes.scatter(evolved.phase, starts, color=BLUE, label="evolved starts", **_DOTS)
    axes.scatter(evolved.reference_phase, reference, color=GREEN, s=4.0, label="reference")
    axes.set_xlim(0, 1)
    told = f"First principal component of the starts ({share:.0%} of what varies)"
    finish(axes, told, PHASE, "component (m)")
    marks = axes.legend(fontsize=8, frameon=False, markerscale=2)
    marks.legend_handles[0].set_alpha(1.0)  # pyright: ignore[reportOptionalMemberAccess]


def distance(evolved: Evolved, axes: Axes) -> None:
    """Draws how far the bodies of each start are from the reference at its phase.

    The distance is the root mean square over bodies, in cm; the line is its median over phase.
    """
    apart = (evolved.places - evolved.at_phase).reshape(len(evolved.phase), -1, 3)
    moved = 100.0 * np.sqrt(np.mean(np.sum(apart**2, axis=-1), axis=-1))
    place, filled = binned(evolved.phase)
    axes.scatter(evolved.phase, moved, color=BLUE, **_DOTS)
    median = [np.median(moved[place == one]) for one in filled]
    axes.plot((filled + 0.5) / BINS, median, color=BLUE, lw=1.8)
    axes.set_xlim(0, 1)
    axes.set_ylim(bottom=0.0)
    told = f"Evolved starts are {np.median(moved):.1f} cm from the reference, in the median"
    finish(axes, told, PHASE, "bodies' distance (cm)")
