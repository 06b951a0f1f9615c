# SPDX-License-Identifier: Apache-2.0
"""How a training went, from the lines of metrics.jsonl: how long episodes last, what ends them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxskills.plot import states
from jaxskills.plot.lines import check, column
from jaxskills.plot.sheet import (
    BLUE,
    CYCLE,
    GREEN,
    GREY,
    ORANGE,
    PHASE,
    RED,
    finish,
    foremost,
    legend_beside,
    say,
)

_LONGEST = 25.0  # s, for what lasts longer than the 20 s of a test is learnt
_REQUIRED = ("samples", "wall_s", "survival_s")


def learning_curve(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws the mean length of episodes, and of evaluated ones, over training samples.

    Raises:
      UserError: no lines, or a line without `samples`, `wall_s` or `survival_s`.
    """
    check(metrics, _REQUIRED)
    samples = _millions(metrics)
    survival = column(metrics, "survival_s")
    mark = "" if len(survival) > 1 else "o"
    axes.plot(samples, survival, color=BLUE, marker=mark, label="training, until a bound")
    for key, colour, label in (
        ("inside_seconds_mean", GREEN, "test, until a bound"),
        ("seconds_mean", ORANGE, "test, until a fall"),
    ):
        values = column(metrics, key)
        seen = np.isfinite(values)
        if seen.any():
            axes.plot(samples[seen], values[seen], "o-", color=colour, ms=3, lw=1, label=label)
    axes.set_xlim(left=0.0)
    axes.set_ylim(0.0, min(axes.get_ylim()[1], _LONGEST))
    scale = column(metrics, "bound_scale")
    if np.isfinite(scale).any():
        right = axes.twinx()
        right.plot(samples, scale, color=RED, lw=1)
        right.set_ylim(bottom=0.0)
        right.set_ylabel("scale of the bounds", fontsize=9, color=RED)
        right.tick_params(labelsize=8)
        right.spines[["top", "left"]].set_visible(False)
    last = metrics[-1]
    told = f"Learning curve: {last['samples'] / 1e6:.3g} million samples, {_duration(last)}"
    finish(axes, told, "samples (millions)", "mean time to a failure (s)")
    axes.legend(fontsize=8, frameon=False)


def causes(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws which share of training episodes each bound ended, from the `ended/<bound>` entries.

    Raises:
      UserError: see `learning_curve`.
    """
    check(metrics, _REQUIRED)
    names = sorted({key for line in metrics for key in line if key.startswith("ended/")})
    all_causes = {n.removeprefix("ended/"): np.nan_to_num(column(metrics, n)) for n in names}
    shown = foremost(all_causes, len(CYCLE))
    finish(axes, "What ended training episodes", "samples (millions)", "share (%)")
    axes.set_ylim(0, 100)
    if not shown:
        say(axes, "no episode has ended yet")
        return
    until = np.append(0.0, _millions(metrics))  # a line counts what happened since the one before
    shares = [100.0 * np.append(share[:1], share) for share in shown.values()]
    colours = (*CYCLE, GREY)
    axes.stackplot(until, shares, labels=list(shown), colors=colours, alpha=0.85)
    axes.margins(x=0)
    legend_beside(axes, reverse=True)  # in the order of the stack


def training_endings(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws where in the cycle training episodes failed, all lines together, and by which bound.

    Raises:
      UserError: see `learning_curve`.
    """
    check(metrics, _REQUIRED)
    recorded = [line["endings"] for line in metrics if "endings" in line]
    if not recorded:
        finish(axes, "Where training episodes ended", PHASE, "")
        axes.set_yticks([])
        say(axes, "not recorded")
        return
    total: dict[str, np.ndarray] = {}
    for name in {name: None for line in recorded for name in line}:
        total[name] = np.sum([line[name] for line in recorded if name in line], axis=0)
    states.endings(total, axes, told="Where {} training episodes ended")


def _millions(metrics: Sequence[Mapping[str, Any]]) -> np.ndarray:
    return column(metrics, "samples") / 1e6


def _duration(line: Mapping[str, Any]) -> str:
    seconds = float(line["wall_s"])
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
