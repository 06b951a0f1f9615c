# SPDX-License-Identifier: Apache-2.0
"""The live line of a training: redrawn in place on a terminal, one line every few seconds else."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

Report = Callable[[Mapping[str, Any]], None]


@contextlib.contextmanager
def live(name: str, total: int, done: int = 0, every: float = 5.0) -> Iterator[Report]:
    """Yields `report(metrics)`; each call shows the newest metrics on standard error.

    Args:
      name: what is trained.
      total: samples at the end of the training.
      done: samples at its beginning, other than 0 for a resumed run.
      every: s between lines where standard error is not a terminal; the last one always shows.

    `metrics` needs `samples` and `survival_s`, as every line of metrics.jsonl has them.
    """
    start = time.monotonic()

    def text(metrics: Mapping[str, Any]) -> str:
        pace = (metrics["samples"] - done) / max(time.monotonic() - start, 1e-9)
        return line(name, total, metrics, pace)

    console = Console(stderr=True)
    if console.is_terminal:
        with Live(console=console, auto_refresh=False) as shown:
            yield lambda metrics: shown.update(Text(text(metrics)), refresh=True)
    else:
        with _lines(text, every) as report:
            yield report


@contextlib.contextmanager
def _lines(text: Callable[[Mapping[str, Any]], str], every: float) -> Iterator[Report]:
    waiting = ""
    due = time.monotonic()

    def report(metrics: Mapping[str, Any]) -> None:
        nonlocal waiting, due
        waiting = text(metrics)
        if time.monotonic() >= due:
            print(waiting, file=sys.stderr, flush=True)
            waiting, due = "", time.monotonic() + every

    try:
        yield report
    finally:
        if waiting:
            print(waiting, file=sys.stderr, flush=True)


def line(name: str, total: int, metrics: Mapping[str, Any], pace: float) -> str:
    """Returns `walk  1.2M of 20M samples (6%)  survival 3.1 s  25k/s  12:33 left`.

    `pace` in samples per second; see `live` for the others. With `worst_bound` and `worst_phase` it
    also says what ends most episodes, and where; with `bound_scale` how wide adaptive bounds are;
    with `fine` that physics steps are finer now. Of a family it says, instead of the survival,
    `23k episodes  exploring  explored 41%  success 93%`; the phase is `base` as long as only the
    reference itself is learnt.
    """
    samples = metrics["samples"]
    ends = ""
    if "worst_bound" in metrics:
        ends = f"  ends by {metrics['worst_bound']} at {metrics['worst_phase']:.0%} of a cycle"
    if metrics.get("fine"):
        ends += "  fine physics"
    if "bound_scale" in metrics:
        ends += f"  bounds x{metrics['bound_scale']:.2f}"
    left = _clock((total - samples) / pace) if pace > 0 else "?"
    how = f"survival {metrics['survival_s']:.1f} s"
    if "explored" in metrics:
        how = _family(metrics)
    return (
        f"{name}  {_short(samples)} of {_short(total)} samples ({samples / total:.0%})"
        f"  {how}{ends}  {_short(pace)}/s  {left} left"
    )


def _family(metrics: Mapping[str, Any]) -> str:
    phase = "refining" if metrics["refining"] else "exploring"
    phase = phase if metrics["base_learnt"] else "base"
    return (
        f"{_short(metrics['episodes'])} episodes  {phase}  explored {metrics['explored']:.0%}"
        f"  success {metrics['success']:.0%}"
    )


def _short(number: float) -> str:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}{letter}"
    return f"{number:.0f}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
