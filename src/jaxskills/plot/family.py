# SPDX-License-Identifier: Apache-2.0
"""How a family was learnt: its curriculum, and what of the task space is explored (FS fig. 5)."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxskills.plot.lines import check, column
from jaxskills.plot.sheet import BLUE, GREEN, GREY, ORANGE, RED, admitted, finish, say
from jaxskills.plot.training import causes

_REQUIRED = ("episodes", "explored", "marginal", "rate_around", "rate_inside", "refining")
_SHADES = {"the reference alone": "#e9ebee", "exploration": "#fde3d0", "refinement": "#d8e6f6"}
_DOTS = {"s": 9.0, "linewidths": 0, "rasterized": True}
_ROW, _TITLE = 3.3, 0.6  # inches
_PANELS = 3  # side by side


@dataclasses.dataclass(frozen=True, eq=False)
class Explored:
    """N elites of a task space with P parameters, in the units of their ranges."""

    names: tuple[str, ...]  # [P]
    ranges: np.ndarray  # [P, 2]
    elites: np.ndarray  # [N, P]
    fitness: np.ndarray  # [N]
    level: float  # density above which a task parameter counts as explored
    # By parameter or pair of them: the density of elites along its range `[G]` or in its plane
    # `[G, G]` (first index: second parameter). Of more than two parameters it is the share of the
    # other ones' ranges that is explored.
    maps: Mapping[tuple[int, ...], np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Asked:
    """E performances of new task parameters."""

    names: tuple[str, ...]  # [M] of the measured parameters
    asked: np.ndarray  # [E, M] in the units of the ranges
    measured: np.ndarray  # [E, M]
    through: np.ndarray  # [E] bool, got through without a fall


def figure(
    path: str | Path,
    title: str,
    metrics: Sequence[Mapping[str, Any]],
    explored: Explored,
    asked: Asked | None = None,
) -> Path:
    """Writes the page with all the pictures and returns its path.

    Args:
      path: .png, .pdf or .svg.
      title: what was learnt.
      metrics: lines of metrics.jsonl.
      explored: the task space.
      asked: performances of new task parameters; None leaves their pictures out.

    Raises:
      UserError: another suffix, or metrics without lines or without what each line must have.
    """
    path = admitted(path)
    check(metrics, _REQUIRED)
    shown = () if asked is None else asked.names[:_PANELS]
    single = len(explored.maps) == 1  # then density and fitness stand side by side
    rows = 4 - single + bool(shown)
    page = Figure(figsize=(11.0, _TITLE + _ROW * rows), dpi=150, layout="constrained")
    page.suptitle(title, fontsize=14, fontweight="bold")
    parts = page.subfigures(rows, 1, squeeze=False)[:, 0]
    curriculum(metrics, parts[0].subplots())
    panels = [
        part.subplots(1, 2 if single else len(explored.maps)) for part in parts[1 : 3 - single]
    ]
    drawn = itertools.product((density, fitness), explored.maps)
    for (draw, place), axes in zip(drawn, np.ravel(panels), strict=True):
        draw(explored, place, axes)
    left, middle, right = parts[3 - single].subplots(1, 3, width_ratios=(3, 3, 4))
    ratio(metrics, left)
    quality(metrics, middle)
    causes(metrics, right)
    if asked is not None and shown:
        panels = parts[-1].subplots(1, _PANELS, squeeze=False)[0]
        for axes, i in itertools.zip_longest(panels, range(len(shown))):
            axes.set_visible(i is not None)
            if i is not None:
                met(asked, i, axes)
    path.parent.mkdir(parents=True, exist_ok=True)
    page.savefig(path)
    return path


def curriculum(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws mean marginal value and exploration rates over updates, phases shaded (FS fig. 5).

    Raises:
      UserError: no lines, or a line without what a family's lines have.
    """
    check(metrics, _REQUIRED)
    updates = np.arange(1, len(metrics) + 1)
    phases = [_phase(line) for line in metrics]
    begin = 0
    for i in range(1, len(phases) + 1):
        if i == len(phases) or phases[i] != phases[begin]:
            first = phases[begin] not in phases[:begin]
            label = phases[begin] if first else None
            axes.axvspan(begin + 0.5, i + 0.5, color=_SHADES[phases[begin]], lw=0, label=label)
            begin = i
    right = axes.twinx()
    known = np.array([phase != "the reference alone" for phase in phases])
    mark = "o" if len(metrics) == 1 else ""
    for key, colour, label, on in (
        ("rate_around", RED, "exploration rate around the explored region", axes),
        ("rate_inside", ORANGE, "and inside of it", axes),
        ("marginal", BLUE, "mean marginal value", right),
    ):
        values = np.where(known, column(metrics, key), np.nan)
        on.plot(updates, values, color=colour, lw=1.4, label=label, marker=mark, ms=3)
    axes.set_xlim(0.5, len(metrics) + 0.5)
    axes.set_ylim(bottom=0.0)
    told = "Curriculum: what practice gives, and where it is"
    finish(axes, told, "updates", "new elites per task parameter")
    axes.grid(False)
    right.set_ylabel("mean marginal value", fontsize=9, color=BLUE)
    right.tick_params(labelsize=8)
    right.spines[["top", "left"]].set_visible(False)
    (left_handles, left_labels), (more_handles, more_labels) = (
        x.get_legend_handles_labels() for x in (axes, right)
    )
    handles, labels = [*left_handles, *more_handles], [*left_labels, *more_labels]
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16)}
    axes.legend(handles, labels, fontsize=8, frameon=False, ncols=6, **below)


def density(explored: Explored, place: tuple[int, ...], axes: Axes) -> None:
    """Draws elites as dots over their density, along one parameter or in the plane of two."""
    values, ends = explored.maps[place], explored.ranges[list(place)]
    dots = explored.elites[:, list(place)]
    title = f"{len(dots)} elites and their density"
    if len(place) == 1:
        grid = np.linspace(ends[0][0], ends[0][1], len(values))
        axes.fill_between(grid, values, where=values > explored.level, color=BLUE, alpha=0.2, lw=0)
        axes.plot(grid, values, color=BLUE, lw=1.6)
        axes.axhline(explored.level, color=GREY, lw=1, ls="--")
        above = {"transform": axes.get_xaxis_transform(), "color": "black", "ms": 10}
        axes.plot(dots[:, 0], np.full(len(dots), 0.03), "|", **above)
        axes.set_xlim(*ends[0])
        axes.set_ylim(bottom=0.0)
        finish(axes, f"{title}; dashed: explored", explored.names[place[0]], "density")
        return
    plane = len(explored.names) == 2
    top = 2.0 * explored.level if plane else 1.0
    extent = (*ends[0], *ends[1])
    drawn = axes.imshow(
        values,
        cmap="RdBu",
        vmin=0,
        vmax=top,
        alpha=0.75,
        origin="lower",
        extent=extent,
        aspect="auto",
    )
    axes.scatter(*dots.T, color="black", **_DOTS)
    _plane(explored, place, axes, title if plane else "Share of the others' ranges explored")
    told = "density" if plane else "share"
    axes.figure.colorbar(drawn, ax=axes, label=told, extend="max" if plane else "neither", pad=0.02)


def fitness(explored: Explored, place: tuple[int, ...], axes: Axes) -> None:
    """Draws the fitness of the elites, along one parameter or in the plane of two."""
    dots = explored.elites[:, list(place)]
    title = f"Fitness of the elites, {explored.fitness.mean():.2f} in the mean" if len(dots) else ""
    if len(place) == 1:
        axes.plot(dots[:, 0], explored.fitness, "o", color=GREEN, ms=4)
        axes.set_xlim(*explored.ranges[place[0]])
        axes.set_ylim(0.0, 1.05 * max(1.0, explored.fitness.max(initial=0.0)))
        finish(axes, title, explored.names[place[0]], "fitness")
    else:
        drawn = axes.scatter(*dots.T, c=explored.fitness, cmap="viridis", vmin=0, **_DOTS)
        _plane(explored, place, axes, title)
        axes.figure.colorbar(drawn, ax=axes, label="fitness", pad=0.02)
    if not len(dots):
        say(axes, "no elites yet")


def ratio(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws the explored share of the task space over episodes (FS fig. 8)."""
    episodes, shares = column(metrics, "episodes"), column(metrics, "explored")
    axes.plot(episodes / 1e3, 100.0 * shares, color=BLUE, marker="o" if len(shares) == 1 else "")
    axes.set_ylim(0, 103)
    axes.set_xlim(left=0.0)
    title = f"{shares[-1]:.0%} explored"
    finish(axes, title, "episodes (thousands)", "explored (%)")


def quality(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws over updates how many episodes got through, how fit they were, and how far off."""
    updates = np.arange(1, len(metrics) + 1)
    mark = "o" if len(metrics) == 1 else ""
    for key, colour, label in (
        ("success", BLUE, "share that got through"),
        ("fitness", GREEN, "fitness"),
        ("task_error", RED, "error of the task, of its range"),
    ):
        axes.plot(updates, column(metrics, key), color=colour, lw=1.2, label=label, marker=mark)
    axes.set_xlim(0.5, len(metrics) + 0.5)
    axes.set_ylim(0.0, 1.7)  # room for the legend
    finish(axes, "Training episodes", "updates", "")
    axes.legend(fontsize=8, frameon=False, loc="upper left")


def met(asked: Asked, i: int, axes: Axes) -> None:
    """Draws the measured values of a parameter against those asked for."""
    good = asked.through
    x, y = asked.asked[:, i], asked.measured[:, i]
    ends = [x.min(), x.max()]
    axes.plot(ends, ends, color=GREY, lw=1)
    axes.scatter(x[good], y[good], color=BLUE, **_DOTS)
    for value in x[~good]:
        axes.axvline(value, ymax=0.04, color=RED, lw=1.5)
    title = f"{asked.names[i]}: {good.sum()} of {len(good)} got through"
    finish(axes, f"{title}, red: falls" if not good.all() else title, "asked for", "measured")


def _plane(explored: Explored, place: tuple[int, ...], axes: Axes, title: str) -> None:
    (x, y), ends = (explored.names[i] for i in place), explored.ranges[list(place)]
    finish(axes, title, x, y)
    axes.grid(False)
    axes.set_xlim(*ends[0])
    axes.set_ylim(*ends[1])


def _phase(line: Mapping[str, Any]) -> str:
    if not line.get("base_learnt", True):
        return "the reference alone"
    return "refinement" if line["refining"] else "exploration"
