# SPDX-License-Identifier: Apache-2.0
"""A trained family played back, for films and for pictures."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from jaxskills import perform, render, task_values
from jaxskills.compilation import jit
from jaxskills.env.task import TaskSpec
from jaxskills.explore import elites as elites_lib
from jaxskills.explore import family as family_lib
from jaxskills.motion import CONTROL_DT
from jaxskills.perform import Performances, task_of
from jaxskills.plot import family as plot_family
from jaxskills.render import Cell
from jaxskills.task_values import Wanted
from jaxskills.trainer import Trainer, TrainState

_AFTER_FALL = 1.0  # s of film after the character has fallen
_MAP = 48  # points along each axis of a map of the task space
_CURVE = 512  # points of a curve
_OTHERS = 64  # points of the other parameters behind each one of a map


def reference(state: TrainState) -> np.ndarray:
    """Returns the normalised task parameter `[P]` of the reference itself."""
    assert state.family is not None
    return np.asarray(state.family.curriculum.reference)


def wanted(made: Trainer, state: TrainState, words: Sequence[str] | None) -> Wanted:
    """Returns the performances that words ask for; None: a grid over the ranges.

    Raises:
      UserError: the run is of one skill, or words that mean nothing.
    """
    spec = task_of(made)
    if words is None:
        return task_values.spread(spec, reference(state))
    return task_values.parse(spec, reference(state), words)


def cells(
    made: Trainer, state: TrainState, wanted: Wanted, seconds: float = 10.0
) -> list[list[Cell]]:
    """Returns performances in rows, each beside its motion m_a, until shortly after its end.

    Raises:
      UserError: the run is of one skill.
    """
    columns, count = wanted.a.shape[1:]
    a = wanted.a.reshape(-1, count)
    done, found = perform.perform(made, state, a), []
    for i, who in enumerate(perform.characters(made, a)):
        until = _until(done, i, seconds)
        poses, shown = (np.asarray(x)[:until, i] for x in (done.trace.qpos, done.reference))
        found.append(Cell(who, poses, shown, wanted.names[i // columns][i % columns]))
    return [found[i : i + columns] for i in range(0, len(found), columns)]


def film(cells: Sequence[Sequence[Cell]], path: Path) -> Path:
    """Films performances, several side by side, each drawn with its own body; returns `path`.

    Raises:
      UserError: another suffix than `render.FORMATS`, or nothing to draw with.
    """
    one, fps = cells[0][0], 1.0 / CONTROL_DT
    if sum(map(len, cells)) > 1:
        return render.grid(cells, path, fps=fps)
    labels = [f"{one.name}   {i * CONTROL_DT:.2f} s" for i in range(len(one.qpos))]
    if path.suffix.lower() == ".png":
        labels = None  # there is no room for more than the time
    cycle = 0.5 * len(one.qpos) * CONTROL_DT  # a strip shows two: all of it
    both = one.character, one.qpos, one.reference_qpos
    return render.film(*both, path, fps=fps, cycle=cycle, labels=labels)


def _until(done: Performances, i: int, seconds: float) -> int:
    """Returns how many steps of a performance are worth a film."""
    fell = not bool(done.through[i])
    until = int(done.steps[i]) + (round(_AFTER_FALL / CONTROL_DT) if fell else 0)
    return max(min(until, round(seconds / CONTROL_DT)), 1)


def explored(made: Trainer, state: TrainState) -> plot_family.Explored:
    """Returns what of the task space is explored, as `plot.family` wants it."""
    spec, family = task_of(made), state.family
    assert family is not None
    rows = np.asarray(family.elites.used)
    low, high = np.array([p.range for p in spec.free], float).T
    return plot_family.Explored(
        names=tuple(p.name for p in spec.free),
        ranges=np.stack((low, high), 1),
        elites=low + (high - low) * np.asarray(family.elites.a)[rows],
        fitness=np.asarray(family.elites.fitness)[rows],
        level=made.config.family.curriculum.sampling.visited,
        maps=_maps(made, state, len(spec.free)),
    )


def asked(made: Trainer, done: Performances) -> plot_family.Asked:
    """Returns what performances were asked for and what came of it, as `plot.family` wants it."""
    spec: TaskSpec = task_of(made)
    measured = [i for i, p in enumerate(spec.free) if p.measure is not None]
    low, high = np.array([spec.free[i].range for i in measured], float).reshape(-1, 2).T
    wanted, met = (low + (high - low) * np.asarray(x)[:, measured] for x in (done.asked, done.met))
    names = tuple(spec.free[i].name for i in measured)
    return plot_family.Asked(names, wanted, met, np.asarray(done.through))


def _maps(made: Trainer, state: TrainState, count: int) -> dict[tuple[int, ...], np.ndarray]:
    """Returns `plot.family.Explored.maps` of the first three of P = `count` parameters."""
    keeping = family_lib.roomy(made.config.family.elites, count)
    level, family = made.config.family.curriculum.sampling.visited, state.family
    assert family is not None

    @jit
    def dense(a: jax.Array) -> jax.Array:  # row by row, which takes less memory
        return jax.lax.map(lambda row: elites_lib.density(keeping, family.elites, row), a)

    if count == 1:
        curve = np.linspace(0.0, 1.0, _CURVE, dtype=np.float32)[:, None]
        return {(0,): np.asarray(dense(curve[None])[0])}
    along = (np.arange(_MAP, dtype=np.float32) + 0.5) / _MAP
    found = {}
    for x, y in ((0, 1),) if count == 2 else ((0, 1), (0, 2), (1, 2)):
        others = elites_lib.spread(_OTHERS, count - 2) if count > 2 else np.zeros((1, 0))
        a = np.zeros((_MAP, _MAP, len(others), count), np.float32)
        a[..., [i for i in range(count) if i not in (x, y)]] = others
        a[..., x], a[..., y] = along[None, :, None], along[:, None, None]
        values = np.asarray(dense(a))
        found[x, y] = values[..., 0] if count == 2 else (values > level).mean(-1)
    return found
