# SPDX-License-Identifier: Apache-2.0
"""A trained controller played back, for films and for pictures."""

from pathlib import Path

import jax
import mujoco
import numpy as np

from jaxskills import evaluate, motion, plot, render
from jaxskills.compilation import jit
from jaxskills.env import bounds
from jaxskills.evaluate import EvaluateConfig, Trace
from jaxskills.motion import CONTROL_DT
from jaxskills.pose import own_bodies
from jaxskills.trainer import PHASE_BINS, Trainer, TrainState

_AFTER_FALL = 1.0  # s of film after the character has fallen, or the motion is over
_STARTS = 4000  # evolved starts that are drawn at most


def play(made: Trainer, state: TrainState, config: EvaluateConfig) -> Trace:
    """Returns what the controller does in the episodes of a configuration.

    Raises:
      UserError: a value out of range.
    """
    return jit(evaluate.make(made, config))(state, jax.random.key(config.seed))


def film(made: Trainer, state: TrainState, path: Path, seconds: float) -> Path:
    """Films one episode beside its reference, until shortly after its end; returns `path`.

    It begins where the clip begins.

    Raises:
      UserError: another suffix than `render.FORMATS`, or nothing to draw with.
    """
    trace = play(made, state, EvaluateConfig(seconds, episodes=1, start=0.0))
    over = np.asarray(trace.fallen | trace.over)
    until = _lengths(over)[0] + round(_AFTER_FALL / CONTROL_DT)
    qpos = np.asarray(trace.qpos)[:until, 0]
    reference = _reference(made, np.asarray(trace.phase)[:until, 0])
    cycle = made.motion.seconds if made.motion.loop else None
    return render.film(made.character, qpos, reference, path, fps=1.0 / CONTROL_DT, cycle=cycle)


def played(made: Trainer, trace: Trace) -> plot.Played:
    """Returns the states of a trace up to each fall, as `plot.figure` wants them."""
    length = made.env.length
    errors, sizes, inside = (np.asarray(x) for x in (trace.errors, trace.sizes, trace.inside))
    steps, episodes, count = errors.shape
    names = made.env.endings[:count]
    standing = np.arange(steps)[:, None] < _lengths(np.asarray(trace.fallen | trace.over))
    margins = (1.0 - errors / sizes)[standing]
    phase = np.asarray(trace.phase) / length
    phase = phase % 1.0 if made.motion.loop else np.minimum(phase, 1.0)
    grid = np.linspace(0.0, 1.0, 101)
    up = names.index("com_z")
    bound = bounds.table(made.character, made.config.bounds)[:, up]
    bound = np.where(bound < bounds.OPEN, bound, np.nan)
    return plot.Played(
        phase=phase[standing],
        height=np.asarray(trace.com)[..., 2][standing],
        reference_phase=grid,
        reference_height=_com_height(made.character.model, _reference(made, grid * length)),
        bound=np.interp(grid, np.linspace(0.0, 1.0, len(bound)), bound),
        margins={name: margins[:, i] for i, name in enumerate(names)},
        endings=_endings(names, errors / sizes, inside, phase),
    )


def evolved(made: Trainer, state: TrainState) -> plot.Evolved | None:
    """Returns the evolved starts of a run, as `plot.figure` wants them; None if they do not evolve.

    Compared are the centres of mass of the bodies, seen from the ground under the root: the root's
    place on the ground is the reference's in every elite.
    """
    if state.elites is None:
        return None
    qpos, phase = np.asarray(state.elites.qpos), np.asarray(state.elites.phase).ravel()
    few = slice(None, None, len(phase) // _STARTS + 1)
    qpos, phase = qpos.reshape(len(phase), -1)[few], phase[few]
    model, grid = made.character.model, np.linspace(0.0, 1.0, 201)
    return plot.Evolved(
        phase=phase / made.env.length,
        places=_places(model, qpos),
        at_phase=_places(model, _reference(made, phase)),
        reference_phase=grid,
        reference=_places(model, _reference(made, grid * made.env.length)),
    )


def _places(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Returns the bodies' centres of mass `[N, 3 bodies]` in m, seen from under the root."""
    data, places = mujoco.MjData(model), []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        places.append(data.xipos[1 : own_bodies(model) + 1] - [*pose[:2], 0.0])
    return np.reshape(places, (len(qpos), -1))


def _endings(
    names: tuple[str, ...], share: np.ndarray, inside: np.ndarray, phase: np.ndarray
) -> dict[str, np.ndarray]:
    """Returns per bound how many episodes left it first, by part of the cycle `[PHASE_BINS]`."""
    counts = {name: np.zeros(PHASE_BINS) for name in (*names, "ground contact")}
    for episode, step in enumerate(_lengths(~inside)):
        if step == len(inside):
            continue
        worst = int(share[step, episode].argmax())
        cause = names[worst] if share[step, episode, worst] > 1.0 else "ground contact"
        place = min(int(phase[step, episode] * PHASE_BINS), PHASE_BINS - 1)
        counts[cause][place] += 1
    return counts


def _lengths(ended: np.ndarray) -> np.ndarray:
    """Returns per episode `[E]` how many steps come before the first true one of `ended [T, E]`."""
    return np.where(ended.any(0), ended.argmax(0), len(ended))


def _reference(made: Trainer, phase: np.ndarray) -> np.ndarray:
    """Returns the poses `[N, nq]` of the reference at `phase [N]` (control frames)."""
    at = jax.vmap(lambda one: motion.sample(made.character.layout, made.motion, one)[0])
    return np.asarray(jit(at)(phase.astype(np.float32)))


def _com_height(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Returns the height of the centre of mass `[N]` in m for poses `[N, nq]`."""
    data, heights = mujoco.MjData(model), []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        heights.append(data.subtree_com[model.jnt_bodyid[0], 2])
    return np.array(heights)
