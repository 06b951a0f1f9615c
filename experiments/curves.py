# SPDX-License-Identifier: Apache-2.0
"""Draws the learning curves of the records under `results/`.

    python experiments/curves.py

Writes `results/curves.png`, SB Table 1 with the paper's counts of samples, and `curves.png` in the
folder of each comparison of which two cases or more are there. Survival is the mean time until a
training episode with noise leaves its bounds (or falls, if that is what ends it), so it is less
than what an evaluation finds.
"""

from pathlib import Path
from typing import Any

import numpy as np
from compare import COMPARISONS
from family_tables import is_family
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tables import PAPER, PASSED, RESULTS, cases, records

from jaxskills.plot.lines import column
from jaxskills.plot.sheet import BLUE, CYCLE, GREY, finish

_TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20)  # s
_AVERAGED = 0.03  # share of a curve that is averaged, for survival jumps from update to update
_COLUMNS = 4


def survival(
    record: dict[str, Any], axes: Axes, color: str, label: str = "", after: int = 0
) -> None:
    """Draws the survival of a skill over its samples, and dots where it was evaluated as learnt.

    It begins with the networks of a training of `after` samples.
    """
    curve = record["curve"][1:]  # hardly any episode has ended in the first update
    samples, seconds = (after + column(curve, "samples")) / 1e6, column(curve, "survival_s")
    width = max(1, round(_AVERAGED * len(seconds)))
    padded = np.pad(np.log(seconds), (width, width), mode="edge")
    level = np.exp(np.convolve(padded, np.full(2 * width + 1, 1 / (2 * width + 1)), "valid"))
    axes.plot(samples, np.minimum(level, _TICKS[-1]), color=color, lw=1.4, label=label)
    passed = column(curve, "success_rate") >= PASSED
    axes.plot(samples[passed], np.minimum(level, _TICKS[-1])[passed], "o", color=color, ms=3)


def comparison(name: str, by_label: dict[str, dict[str, Any]]) -> Figure:
    """Returns the curves of a comparison's cases: survival, or how much is explored."""
    page = Figure(figsize=(6.2, 3.0), dpi=110, layout="constrained")
    axes = page.subplots()
    families = all(map(is_family, by_label.values()))
    for colour, (label, record) in zip(CYCLE, by_label.items(), strict=False):
        if families:
            episodes = column(record["curve"], "episodes") / 1e6
            explored = column(record["curve"], "explored")
            axes.plot(episodes, explored, color=colour, lw=1.4, label=label)
        else:
            earlier = by_label.get(COMPARISONS[name][label].after.removeprefix(f"{name}/"))
            survival(record, axes, colour, label, earlier["samples"] if earlier else 0)
    if families:
        finish(axes, "", "episodes (millions)", "explored share of the task space")
        axes.set_ylim(0.0, 1.02)
    else:
        finish(axes, "", "samples (millions)", "survival with noise (s)")
        _seconds(axes)
    axes.set_xlim(left=0.0)
    axes.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return page


def table1(found: dict[str, list[dict[str, Any]]]) -> Figure:
    """Returns the curves of SB Table 1, a panel for each skill and a line for each seed."""
    rows = -(-len(found) // _COLUMNS)
    page = Figure(figsize=(2.6 * _COLUMNS, 2.3 * rows), dpi=110, layout="constrained")
    panels = page.subplots(rows, _COLUMNS, squeeze=False, sharex=True, sharey=True).ravel()
    for i, (axes, (skill, seeds)) in enumerate(zip(panels, found.items(), strict=False)):
        for record in seeds:
            survival(record, axes, BLUE)
        axes.axvline(PAPER[skill] / 1e6, color=GREY, lw=1, ls="--")
        lowest = i + _COLUMNS >= len(found)
        first = "survival (s)" if i % _COLUMNS == 0 else ""
        finish(axes, skill, "samples (millions)" if lowest else "", first)
        axes.tick_params(labelbottom=lowest)
    panels[0].set_xscale("log")
    panels[0].set_xlim(0.02, 60.0)
    panels[0].set_xticks((0.1, 1, 10), ("0.1", "1", "10"))
    _seconds(panels[0])
    for axes in panels[len(found) :]:
        axes.set_visible(False)
    page.suptitle(
        "dashed: samples of the paper; dots: 95 % of evaluated episodes stood", fontsize=9
    )
    return page


def _seconds(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.set_yticks(_TICKS, [str(tick) for tick in _TICKS])
    axes.minorticks_off()
    axes.set_ylim(_TICKS[0], 1.1 * _TICKS[-1])


def draw(results: Path) -> list[Path]:
    """Draws everything of a folder of results; returns what was written."""
    by_skill: dict[str, list[dict[str, Any]]] = {}
    for record in records(results):
        if record["skill"] in PAPER:
            by_skill.setdefault(record["skill"], []).append(record)
    pages = {results / "curves.png": table1(by_skill)} if by_skill else {}
    for name in COMPARISONS:
        found = cases(results, name)
        if len(found) > 1:
            pages[results / name / "curves.png"] = comparison(name, found)
    for path, page in pages.items():
        page.savefig(path)
    return list(pages)


if __name__ == "__main__":
    for path in draw(RESULTS):
        print(path.relative_to(RESULTS.parent))
