# SPDX-License-Identifier: Apache-2.0
"""Evaluation of a family: does it do what new task parameters ask for, and how closely.

Parameters that it was not trained on, spread evenly over the task space, are performed once each.
What a condition asks for (gravity, sizes of the body) is met by construction, so that only the
measured quantities have errors.
"""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills.env import task as task_lib
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.explore import elites as elites_lib
from jaxskills.explore import family as family_lib
from jaxskills.motion import CONTROL_DT
from jaxskills.perform import Performances, task_of
from jaxskills.trainer import Trainer, TrainState

_POINTS = 4096  # of the task space, at which it is looked where it is explored


@dataclasses.dataclass(frozen=True)
class FamilyEvaluateConfig:
    """What is measured."""

    episodes: int = 50  # task parameters, each performed once
    substeps: int | None = None  # physics steps per control step; None: as in the training
    seed: int = 1  # of the task parameters


def parameters(made: Trainer, config: FamilyEvaluateConfig) -> np.ndarray:
    """Returns normalised task parameters `[E, P]` spread evenly, at a place that the seed decides.

    Raises:
      UserError: the run is of one skill, or a value out of range.
    """
    if not 1 <= config.episodes <= 65536:
        raise UserError(f"episodes is {config.episodes}: give 1 to 65536")
    count = len(task_of(made).free)
    shift = np.random.default_rng(config.seed).uniform(size=count)
    return ((elites_lib.spread(config.episodes, count) + shift) % 1.0).astype(np.float32)


def summary(made: Trainer, state: TrainState, done: Performances) -> dict[str, Any]:
    """Returns the figures of performances, JSON-ready.

    `success_rate`: share that got through the motion without a fall. `seconds_mean`: until the fall
    or the end. `inside_bounds_rate`: share that never left the bounds. Of those that got through,
    if any: `fitness_mean`; `constraint_mean`, 0 to 1, if the task has constraints; `errors` by
    parameter: mean and 95th percentile of how far the measured quantity is from the one asked for,
    as a share of that, or in its own unit where the range is absolute. Of the training:
    `training_episodes` (N of FS Table 1), `explored` (ER), and `explored_ranges` by parameter. At
    last each of the `performances` by itself.
    """
    spec, family = task_of(made), state.family
    assert family is not None
    through = np.asarray(done.through)
    inside = np.asarray(done.trace.inside).all(0)
    found: dict[str, Any] = {
        "success_rate": float(through.mean()),
        "seconds_mean": float(np.asarray(done.steps).mean() * CONTROL_DT),
        "inside_bounds_rate": float(inside.mean()),
        "episodes": len(through),
    }
    if through.any():
        found["fitness_mean"] = float(np.asarray(done.fitness)[through].mean())
    if through.any() and any(p.fixed for p in spec.measured):
        found["constraint_mean"] = float(np.asarray(done.constraint)[through].mean())
    asked, met = (np.asarray(x, float) for x in (done.asked, done.met))
    found["errors"] = errors(spec, asked[through], met[through]) if through.any() else {}
    ratio, ranges = explored(made, state)
    found |= {"explored": ratio, "explored_ranges": ranges}
    found["training_episodes"] = int(family.episodes)
    found["performances"] = [
        {
            "asked": task_lib.in_units(spec, asked[i]),
            "measured": _measured(spec, met[i]) if through[i] else None,
            "success": bool(through[i]),
        }
        for i in range(len(through))
    ]
    return found


def errors(spec: TaskSpec, asked: np.ndarray, met: np.ndarray) -> dict[str, dict[str, Any]]:
    """Returns by measured parameter how far `met [E, P]` is from `asked [E, P]`, both normalised.

    `mean` and `p95`, the 95th percentile; `relative` says whether they are shares of what was asked
    for, or in the unit of the range. `share` is the mean as a share of one or the other.
    """
    found = {}
    for parameter, wanted, got in _pairs(spec, asked, met):
        share = _share(parameter, wanted, got)
        off = share if parameter.relative else np.abs(got - wanted)
        found[parameter.name] = {
            "mean": float(off.mean()),
            "p95": float(np.quantile(off, 0.95)),
            "relative": parameter.relative,
            "share": float(share.mean()),
        }
    return found


def shares(made: Trainer, asked: np.ndarray, met: np.ndarray) -> dict[str, np.ndarray]:
    """Returns by measured parameter how far each of `met [E, P]` is from `asked [E, P]`.

    As a share of what was asked for, or of the range where that is absolute.
    """
    return {
        parameter.name: _share(parameter, wanted, got)
        for parameter, wanted, got in _pairs(task_of(made), asked, met)
    }


def _share(parameter: Parameter, wanted: np.ndarray, got: np.ndarray) -> np.ndarray:
    low, high = parameter.range
    return np.abs(got - wanted) / (np.abs(wanted) if parameter.relative else high - low)


def _pairs(
    spec: TaskSpec, asked: np.ndarray, met: np.ndarray
) -> Iterator[tuple[Parameter, np.ndarray, np.ndarray]]:
    """Yields the measured parameters with the values `[E]` that were asked for, and came of it."""
    for i, parameter in enumerate(spec.free):
        if parameter.measure is not None:
            yield parameter, _values(parameter, asked[:, i]), _values(parameter, met[:, i])


def explored(made: Trainer, state: TrainState) -> tuple[float, dict[str, list[float] | None]]:
    """Returns ER of FS Table 1, and by parameter how far the explored region reaches (Table 2).

    That is from the lowest to the highest value that is heavily visited, whatever the others are;
    None where nothing is.
    """
    spec, family, config = task_of(made), state.family, made.config.family
    assert family is not None
    keeping = family_lib.roomy(config.elites, len(spec.free))
    level = config.curriculum.sampling.visited
    ratio = elites_lib.explored_ratio(keeping, family.elites, level)
    places = elites_lib.spread(_POINTS, len(spec.free))
    dense = np.asarray(elites_lib.density(keeping, family.elites, jnp.asarray(places))) > level
    ranges: dict[str, list[float] | None] = {p.name: None for p in spec.free}
    if dense.any():
        for i, parameter in enumerate(spec.free):
            values = _values(parameter, places[dense, i])
            ranges[parameter.name] = [float(values.min()), float(values.max())]
    return float(jax.device_get(ratio)), ranges


def lines(found: dict[str, Any]) -> list[str]:
    """Returns the figures of `summary` for people, one a line."""
    rows = [f"{k:28} {v:.4g}" for k, v in found.items() if isinstance(v, float)]
    rows += [f"{k:28} {v}" for k, v in found.items() if isinstance(v, int)]
    for name, error in found["errors"].items():
        mean, worst = (
            f"{error[key]:.1%}" if error["relative"] else f"{error[key]:.3g}"
            for key in ("mean", "p95")
        )
        share = "" if error["relative"] else f" ({error['share']:.1%} of the range)"
        rows.append(f"{'error of ' + name:28} {mean} in the mean{share}, 95 % below {worst}")
    for name, ends in found["explored_ranges"].items():
        text = "nothing yet" if ends is None else f"{ends[0]:.3g} to {ends[1]:.3g}"
        rows.append(f"{'explored ' + name:28} {text}")
    return rows


def _values(parameter: Parameter, normalised: np.ndarray) -> np.ndarray:
    low, high = parameter.range
    return low + (high - low) * normalised


def _measured(spec: TaskSpec, met: np.ndarray) -> dict[str, float]:
    found = task_lib.in_units(spec, met)
    return {p.name: found[p.name] for p in spec.free if p.measure is not None}
