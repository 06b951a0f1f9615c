# SPDX-License-Identifier: Apache-2.0
"""Where a trained controller goes within its bounds, over phase, and where it leaves them."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxskills.plot.sheet import (
    BINS,
    BLUE,
    CYCLE,
    GREEN,
    PHASE,
    RED,
    binned,
    finish,
    foremost,
    legend_beside,
    say,
)

_DOTS = 20000  # more only make one blot
_COLUMNS = 5  # of small pictures side by side


def com_height(
    phase: np.ndarray,
    height: np.ndarray,
    reference_phase: np.ndarray,
    reference_height: np.ndarray,
    bound: float | np.ndarray,
    axes: Axes,
) -> None:
    """Draws the height of the CoM over phase, as SB fig. 5: reference, bounds, learnt states.

    Args:
      phase: [N] of states of the learnt controller.
      height: [N] m.
      reference_phase: [R] increasing.
      reference_height: [R] m.
      bound: m, size of the bound, one number or `[R]`.
      axes: where to draw.
    """
    few = slice(None, None, len(phase) // _DOTS + 1)
    dots = {"s": 2.0, "color": BLUE, "alpha": 0.35, "linewidths": 0, "rasterized": True}
    axes.scatter(phase[few], height[few], label="learnt", **dots)
    axes.plot(reference_phase, reference_height, color=GREEN, lw=2, label="reference")
    for sign in (-1, 1):
        edge = reference_height + sign * bound
        axes.plot(reference_phase, edge, color=RED, lw=1.5, label="bounds" if sign > 0 else None)
    axes.set_xlim(0, 1)
    low, high = axes.get_ylim()
    axes.set_ylim(top=high + 0.12 * (high - low))  # room for the legend
    finish(axes, "Height of the centre of mass", PHASE, "height (m)")
    marks = axes.legend(fontsize=8, frameon=False, ncols=3, loc="upper center", markerscale=3)
    marks.legend_handles[0].set_alpha(1.0)  # pyright: ignore[reportOptionalMemberAccess]


def margins(
    phase: np.ndarray, by_bound: Mapping[str, np.ndarray], axes: Axes, shown: int = 4
) -> None:
    """Draws mean and worst over phase of the margins to the tightest bounds.

    Args:
      phase: [N].
      by_bound: bound -> margins [N]: 1 on the reference, 0 at the bound, below 0 outside.
      axes: where to draw.
      shown: how many bounds, those with the smallest margins.
    """
    tightest = sorted(by_bound, key=lambda name: float(np.quantile(by_bound[name], 0.01)))[:shown]
    place, filled = binned(phase)
    middle = (filled + 0.5) / BINS
    for name, colour in zip(tightest, CYCLE, strict=False):
        groups = [by_bound[name][place == one] for one in filled]
        worst, mean = (np.array([f(group) for group in groups]) for f in (np.min, np.mean))
        axes.fill_between(middle, worst, mean, color=colour, alpha=0.12, linewidth=0)
        axes.plot(middle, mean, color=colour, lw=1.8, label=name)
        axes.plot(middle, worst, color=colour, lw=0.9, ls="--")
    axes.axhline(0.0, color=RED, lw=1.5)
    axes.set_xlim(0, 1)
    axes.set_ylim(max(axes.get_ylim()[0], -1.0), 1.05)
    told = f"Margins of the {len(tightest)} tightest of {len(by_bound)} bounds: mean, worst"
    finish(axes, told, PHASE, "margin (1 reference, 0 bound)")
    legend_beside(axes)


def regions_height(count: int) -> float:
    """Returns the height in inches that `regions` needs for that many bounds."""
    return 0.6 + 1.25 * -(-count // _COLUMNS)


def regions(
    phase: np.ndarray, by_bound: Mapping[str, np.ndarray], page: SubFigure | Figure
) -> None:
    """Draws for every bound the region that is really used: least, mean and largest margin.

    It is what SB fig. 1 shows in blue for one bound: how much of the room the controller needs, and
    where. A name is red if that bound was left; beside it stands the least margin.

    Args:
      phase: [N].
      by_bound: bound -> margins [N]: 1 on the reference, 0 at the bound, below 0 outside.
      page: where to draw; `regions_height` says how high it should be.
    """
    page.suptitle(
        "Room used within every bound over phase: from the reference (1) to the bound (0);"
        " beside each name the least margin",
        fontsize=10.5,
        x=0.01,
        ha="left",
    )
    rows = -(-len(by_bound) // _COLUMNS)
    panels = page.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
    place, filled = binned(phase)
    middle = (filled + 0.5) / BINS
    lowest = 0.0
    for axes, (name, values) in zip(panels, by_bound.items(), strict=False):
        groups = [values[place == one] for one in filled]
        least, mean, most = (np.array([f(g) for g in groups]) for f in (np.min, np.mean, np.max))
        axes.fill_between(middle, least, most, color=BLUE, alpha=0.25, linewidth=0)
        axes.plot(middle, mean, color=BLUE, lw=1.2)
        axes.axhline(0.0, color=RED, lw=1.0)
        worst = float(np.min(values, initial=1.0))
        finish(axes, "", "", "")
        axes.set_title(
            f"{name}  {worst:.2f}", fontsize=8, loc="left", color=RED if worst < 0 else "black"
        )
        axes.tick_params(labelsize=7)
        lowest = min(lowest, worst)
    for axes in panels[len(by_bound) :]:
        axes.set_visible(False)
    panels[0].set_xlim(0, 1)
    panels[0].set_ylim(max(lowest, -1.0) - 0.05, 1.05)


def endings(
    by_bound: Mapping[str, np.ndarray],
    axes: Axes,
    shown: int = 8,
    told: str = "Where {} tested episodes left the bounds",
) -> None:
    """Draws a map of how many episodes each bound ended at which phase.

    Args:
      by_bound: bound -> counts [P] over P equal parts of the cycle.
      axes: where to draw.
      shown: how many bounds have a row of their own, those that ended most; others share one.
      told: the title, with a place for how many episodes.
    """
    rows = foremost({n: np.asarray(c, float) for n, c in by_bound.items()}, shown)
    episodes = int(sum(counts.sum() for counts in rows.values()))
    finish(axes, told.format(episodes), PHASE, "")
    axes.grid(False)
    axes.set_xlim(0, 1)
    if not rows:
        axes.set_yticks([])
        say(axes, "none did")
        return
    table, extent = np.array(list(rows.values())), (0.0, 1.0, float(len(rows)), 0.0)
    drawn = axes.imshow(table, cmap="Blues", vmin=0, aspect="auto", extent=extent)
    names = [f"{name} ({counts.sum():.0f})" for name, counts in rows.items()]
    axes.set_yticks(np.arange(len(rows)) + 0.5, names)
    axes.figure.colorbar(drawn, ax=axes, label="episodes", pad=0.01)
