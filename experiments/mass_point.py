# SPDX-License-Identifier: Apache-2.0
"""The idea of spacetime bounds on a mass point (SB section 3.1 and figure 2).

    python experiments/mass_point.py [--out feasible.png]

A point on a line, |acceleration| <= 2 m/s^2, starts and ends at rest at x = 0, five seconds apart.
Its *feasible region* is every (x, v, t) on a trajectory that can do that and respects the bounds.
It is computed exactly for accelerations that are constant over a step and one of -a, 0, a: then v
stays on a lattice of spacing a dt, and x on one of spacing a dt^2 / 2, without rounding.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import pyplot as plt

ACCELERATION = 2.0  # m/s^2, SB section 3.1
DURATION = 5.0  # s, from event e1 to event e2


class Bound(NamedTuple):
    """At `time`, x and v must lie in these intervals (SB eq. 1)."""

    time: float  # s
    x: tuple[float, float]  # m
    v: tuple[float, float]  # m/s


B1 = Bound(5 / 3, (0.5, 2.5), (-1.0, 1.0))
B2 = Bound(10 / 3, (-2.5, -0.5), (-1.0, 1.0))


class Region(NamedTuple):
    """Which events are feasible, and where they are."""

    events: np.ndarray  # [T + 1, V, X] bool
    v: np.ndarray  # [V] m/s
    x: np.ndarray  # [X] m
    dt: float  # s

    @property
    def volume(self) -> float:
        """Volume in m x m/s x s. Only every other lattice point of x can be reached."""
        cell = 2.0 * (self.x[1] - self.x[0]) * (self.v[1] - self.v[0]) * self.dt
        return float(self.events.sum() * cell)


def feasible(bounds: tuple[Bound, ...], steps: int = 60) -> Region:
    """Returns the feasible region of events e1, e2 and some bounds.

    Args:
      bounds: at times that are whole steps of `DURATION / steps`.
      steps: of time; the lattice of v and x becomes finer with it.
    """
    dt = DURATION / steps
    half = steps // 2 + 1  # the fastest that still comes to rest
    v = np.arange(-half, half + 1) * ACCELERATION * dt
    far = half * half + half
    x = np.arange(-far, far + 1) * ACCELERATION * dt * dt / 2.0
    admitted = np.ones((steps + 1, len(v), len(x)), bool)
    rest = (np.abs(v) < 1e-9)[:, None] & (np.abs(x) < 1e-9)
    admitted[0] = admitted[-1] = rest
    for bound in bounds:
        admitted[round(bound.time / dt)] &= _within(v, bound.v)[:, None] & _within(x, bound.x)
    ahead = _reach(admitted, forward=True)
    back = _reach(admitted[::-1], forward=False)[::-1]
    return Region(ahead & back, v, x, dt)


def _within(values: np.ndarray, interval: tuple[float, float]) -> np.ndarray:
    return (values >= interval[0] - 1e-9) & (values <= interval[1] + 1e-9)


def _reach(admitted: np.ndarray, forward: bool) -> np.ndarray:
    """Returns the events that can be reached from the first row of `admitted [T + 1, V, X]`.

    A step with acceleration s a, s in -1, 0, 1, takes velocity j to j + s and position i to
    i + 2 j + s. Backwards, with time reversed, j + s and i + 2 j + s lead to j and i.
    """
    reached = np.zeros_like(admitted)
    reached[0] = admitted[0]
    count = admitted.shape[1]
    for now, following, limit in zip(reached[:-1], reached[1:], admitted[1:], strict=True):
        for row in range(count):
            for s in (-1, 0, 1):
                if not 0 <= row + s < count or not now[row if forward else row + s].any():
                    continue
                shift = 2 * (row - count // 2) + s
                if forward:
                    following[row + s] |= _shifted(now[row], shift)
                else:
                    following[row] |= _shifted(now[row + s], -shift)
        following &= limit
    return reached


def _shifted(row: np.ndarray, by: int) -> np.ndarray:
    """Returns `row [X]` moved to the right, with nothing coming in."""
    moved = np.zeros_like(row)
    if by >= 0:
        moved[by:] = row[: len(row) - by]
    else:
        moved[:by] = row[-by:]
    return moved


CASES = {"e1, e2": (), "e1, e2, b1": (B1,), "e1, e2, b1, b2": (B1, B2)}


def draw(regions: dict[str, Region], path: Path) -> None:
    """Draws what of (x, t) each region covers, and the bounds, as in SB figure 2."""
    figure, axes = plt.subplots(1, len(regions), figsize=(10, 3), sharey=True, layout="tight")
    for axis, (name, region), bounds in zip(axes, regions.items(), CASES.values(), strict=True):
        times = np.arange(len(region.events)) * region.dt
        some = np.asarray(region.events.any(axis=1))
        low = region.x[some.argmax(axis=1)]
        high = region.x[len(region.x) - 1 - some[:, ::-1].argmax(axis=1)]
        axis.fill_between(times, low, high, alpha=0.4)
        for bound in bounds:
            axis.plot([bound.time] * 2, bound.x, color="tab:red", linewidth=3)
        axis.set_title(f"{name}: {region.volume:.2f}")
        axis.set_xlabel("t (s)")
    axes[0].set_ylabel("x (m)")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    """Prints the volumes, and draws."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=60, help="of time, a multiple of 3")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    regions = {name: feasible(bounds, options.steps) for name, bounds in CASES.items()}
    for name, region in regions.items():
        print(f"{name:16} {region.volume:8.3f} m m/s s")
    if options.out:
        draw(regions, options.out)


if __name__ == "__main__":
    main()
