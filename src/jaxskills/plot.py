# SPDX-License-Identifier: Apache-2.0
"""Pictures of a training: learning curve, what ended episodes, CoM height and margins over phase.

Everything is drawn on plain matplotlib figures, without pyplot: no window, no global state.
Phases are shares of a cycle, 0 to 1.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxskills.errors import UserError, unknown

FORMATS = (".png", ".pdf", ".svg")

_BLUE, _GREEN, _RED, _ORANGE, _GREY = "#3568a5", "#2a8f52", "#c23b33", "#d9822b", "#8a9099"
# Told apart in print and by the colour-blind; more causes than this are shown as one.
_CYCLE = (_BLUE, _ORANGE, "#5aa897", "#b0507f", "#7c64b5", "#a8923a")

_REQUIRED = ("samples", "wall_s", "survival_s")
_BINS = 40  # of phase
_DOTS = 20000  # more only make one blot


@dataclasses.dataclass(frozen=True, eq=False)
class Played:
    """N states of a trained controller. A margin is 1 on the reference and 0 at the bound."""

    phase: np.ndarray  # [N]
    height: np.ndarray  # [N] m, of the CoM
    reference_phase: np.ndarray  # [R]
    reference_height: np.ndarray  # [R] m, of the CoM
    bound: float  # m, size of the bound on the height of the CoM
    margins: Mapping[str, np.ndarray]  # bound -> [N]
    endings: Mapping[str, np.ndarray]  # bound -> [P] episodes it ended in each P-th of the cycle


def figure(
    path: str | Path, title: str, metrics: Sequence[Mapping[str, Any]], played: Played | None
) -> Path:
    """Writes the page with all the pictures and returns its path.

    Args:
      path: .png, .pdf or .svg.
      title: what was learnt.
      metrics: lines of metrics.jsonl.
      played: states of the trained controller; None leaves their pictures out.

    Raises:
      UserError: another suffix, or metrics without lines or without what each line must have.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise unknown("picture format", path.suffix, FORMATS)
    rows = 1 if played is None else 3
    page = Figure(figsize=(11.0, 0.6 + 3.4 * rows), dpi=150, layout="constrained")
    page.suptitle(title, fontsize=14, fontweight="bold")
    grid = page.add_gridspec(rows, 2)
    learning_curve(metrics, page.add_subplot(grid[0, 0]))
    causes(metrics, page.add_subplot(grid[0, 1]))
    if played is not None:
        com_height(
            played.phase,
            played.height,
            played.reference_phase,
            played.reference_height,
            played.bound,
            page.add_subplot(grid[1, 0]),
        )
        margins(played.phase, played.margins, page.add_subplot(grid[1, 1]))
        endings(played.endings, page.add_subplot(grid[2, :]))
    path.parent.mkdir(parents=True, exist_ok=True)
    page.savefig(path)
    return path


def learning_curve(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws the mean length of episodes, and of evaluated ones, over training samples.

    Raises:
      UserError: no lines, or a line without `samples`, `wall_s` or `survival_s`.
    """
    _check(metrics)
    samples = _millions(metrics)
    survival = _column(metrics, "survival_s")
    mark = "" if len(survival) > 1 else "o"
    axes.plot(samples, survival, color=_BLUE, marker=mark, label="training, until a bound")
    for key, colour, label in (
        ("inside_seconds_mean", _GREEN, "test, until a bound"),
        ("seconds_mean", _ORANGE, "test, until a fall"),
    ):
        values = _column(metrics, key)
        seen = np.isfinite(values)
        if seen.any():
            axes.plot(samples[seen], values[seen], "o-", color=colour, ms=3, lw=1, label=label)
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    last = metrics[-1]
    told = f"Learning curve: {last['samples'] / 1e6:.3g} million samples, {_duration(last)}"
    _finish(axes, told, "samples (millions)", "mean length of an episode (s)")
    axes.legend(fontsize=8, frameon=False)


def causes(metrics: Sequence[Mapping[str, Any]], axes: Axes) -> None:
    """Draws which share of training episodes each bound ended, from the `ended/<bound>` entries.

    Raises:
      UserError: see `learning_curve`.
    """
    _check(metrics)
    names = sorted({key for line in metrics for key in line if key.startswith("ended/")})
    all_causes = {n.removeprefix("ended/"): np.nan_to_num(_column(metrics, n)) for n in names}
    shown = _foremost(all_causes, len(_CYCLE))
    _finish(axes, "What ended training episodes", "samples (millions)", "share (%)")
    axes.set_ylim(0, 100)
    if not shown:
        _say(axes, "no episode has ended yet")
        return
    until = np.append(0.0, _millions(metrics))  # a line counts what happened since the one before
    shares = [100.0 * np.append(share[:1], share) for share in shown.values()]
    colours = (*_CYCLE, _GREY)
    axes.stackplot(until, shares, labels=list(shown), colors=colours, alpha=0.85)
    axes.margins(x=0)
    _legend_beside(axes, reverse=True)  # in the order of the stack


def com_height(
    phase: np.ndarray,
    height: np.ndarray,
    reference_phase: np.ndarray,
    reference_height: np.ndarray,
    bound: float,
    axes: Axes,
) -> None:
    """Draws the height of the CoM over phase, as SB fig. 5: reference, bounds, learnt states.

    Args:
      phase: [N] of states of the learnt controller.
      height: [N] m.
      reference_phase: [R] increasing.
      reference_height: [R] m.
      bound: m, size of the bound.
      axes: where to draw.
    """
    few = slice(None, None, len(phase) // _DOTS + 1)
    dots = {"s": 2.0, "color": _BLUE, "alpha": 0.35, "linewidths": 0, "rasterized": True}
    axes.scatter(phase[few], height[few], label="learnt", **dots)
    axes.plot(reference_phase, reference_height, color=_GREEN, lw=2, label="reference")
    for sign in (-1, 1):
        edge = reference_height + sign * bound
        axes.plot(reference_phase, edge, color=_RED, lw=1.5, label="bounds" if sign > 0 else None)
    axes.set_xlim(0, 1)
    low, high = axes.get_ylim()
    axes.set_ylim(top=high + 0.12 * (high - low))  # room for the legend
    _finish(axes, "Height of the centre of mass", "phase (share of a cycle)", "height (m)")
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
    place = np.clip((np.asarray(phase) * _BINS).astype(int), 0, _BINS - 1)
    filled = np.unique(place)
    middle = (filled + 0.5) / _BINS
    for name, colour in zip(tightest, _CYCLE, strict=False):
        groups = [by_bound[name][place == one] for one in filled]
        worst, mean = (np.array([f(group) for group in groups]) for f in (np.min, np.mean))
        axes.fill_between(middle, worst, mean, color=colour, alpha=0.12, linewidth=0)
        axes.plot(middle, mean, color=colour, lw=1.8, label=name)
        axes.plot(middle, worst, color=colour, lw=0.9, ls="--")
    axes.axhline(0.0, color=_RED, lw=1.5)
    axes.set_xlim(0, 1)
    axes.set_ylim(max(axes.get_ylim()[0], -1.0), 1.05)
    told = f"Margins of the {len(tightest)} tightest of {len(by_bound)} bounds: mean, worst"
    _finish(axes, told, "phase (share of a cycle)", "margin (1 reference, 0 bound)")
    _legend_beside(axes)


def endings(by_bound: Mapping[str, np.ndarray], axes: Axes, shown: int = 8) -> None:
    """Draws a map of how many episodes each bound ended at which phase.

    Args:
      by_bound: bound -> counts [P] over P equal parts of the cycle.
      axes: where to draw.
      shown: how many bounds have a row of their own, those that ended most; others share one.
    """
    rows = _foremost({n: np.asarray(c, float) for n, c in by_bound.items()}, shown)
    episodes = int(sum(counts.sum() for counts in rows.values()))
    _finish(
        axes, f"Where {episodes} tested episodes left the bounds", "phase (share of a cycle)", ""
    )
    axes.grid(False)
    axes.set_xlim(0, 1)
    if not rows:
        axes.set_yticks([])
        _say(axes, "none did")
        return
    table, extent = np.array(list(rows.values())), (0.0, 1.0, float(len(rows)), 0.0)
    drawn = axes.imshow(table, cmap="Blues", vmin=0, aspect="auto", extent=extent)
    names = [f"{name} ({counts.sum():.0f})" for name, counts in rows.items()]
    axes.set_yticks(np.arange(len(rows)) + 0.5, names)
    axes.figure.colorbar(drawn, ax=axes, label="episodes", pad=0.01)


def _check(metrics: Sequence[Mapping[str, Any]]) -> None:
    if not metrics:
        raise UserError("there is nothing to plot: metrics.jsonl has no lines yet")
    for number, line in enumerate(metrics, 1):
        missing = [key for key in _REQUIRED if key not in line]
        if missing:
            raise UserError(f"line {number} of metrics.jsonl lacks {', '.join(missing)}")


def _column(metrics: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """Returns an entry of every line, NaN where a line lacks it."""
    return np.array([line.get(key, np.nan) for line in metrics], float)


def _millions(metrics: Sequence[Mapping[str, Any]]) -> np.ndarray:
    return _column(metrics, "samples") / 1e6


def _foremost(rows: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Returns the `count` rows with the largest sums, then the sum of the others; no empty rows."""
    ordered = sorted((n for n in rows if rows[n].sum() > 0), key=lambda n: -rows[n].sum())
    kept = {name: rows[name] for name in ordered[:count]}
    others = ordered[count:]
    if others:
        kept[f"{len(others)} others"] = np.sum([rows[name] for name in others], axis=0)
    return kept


def _finish(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e3e5e8", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend_beside(axes: Axes, reverse: bool = False) -> None:
    beside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
    axes.legend(fontsize=8, frameon=False, reverse=reverse, **beside)


def _say(axes: Axes, text: str) -> None:
    middle = {"transform": axes.transAxes, "ha": "center", "va": "center"}
    axes.text(0.5, 0.5, text, fontsize=11, color=_GREY, **middle)


def _duration(line: Mapping[str, Any]) -> str:
    seconds = float(line["wall_s"])
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
