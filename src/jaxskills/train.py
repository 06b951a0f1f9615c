# SPDX-License-Identifier: Apache-2.0
"""The training loop that a person starts: updates, evaluations, metrics, checkpoints, the end.

All learning is in `trainer.update`; what happens here never changes the state, so a run's bits do
not depend on how often it is looked at, saved or evaluated.
"""

import json
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tensorboardX import SummaryWriter

from jaxskills import checkpoint, families, paths, trainer, warm_start
from jaxskills import judge as judge_lib
from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.explore import family
from jaxskills.motion import CONTROL_DT
from jaxskills.trainer import TrainConfig, Trainer, TrainState

SAVE_SECONDS = 120.0  # between checkpoints
_LOG_UPDATES = 5  # between lines of metrics.jsonl
Report = Callable[[Mapping[str, Any]], None]


def train(
    config: TrainConfig, run: Path, report: Report, resume: bool = False
) -> tuple[Trainer, TrainState, dict[str, Any]]:
    """Trains until the skill is learnt, the samples are used up, or Ctrl-C.

    Args:
      config: all settings; on `resume` those that the run began with, or changed by the user.
      run: folder to write to.
      report: called with every line of metrics.
      resume: go on from the newest checkpoint; a run that is learnt is over, with equal settings.

    Returns:
      The trainer, the last state, which is saved, and the last metrics; their entry `why` is
      "learnt", "samples used up" or "interrupted".

    Raises:
      UserError: bad settings, a run folder that is in use or cannot be resumed, or no such run to
        begin with.
    """
    begin = time.monotonic()
    made = families.make(config)
    history: list[dict[str, Any]] = []
    if resume:
        state = checkpoint.restore(run, made)
        history = _rewind(run, int(state.samples))
        if history and history[-1].get("learnt") and config == checkpoint.read_config(run):
            return trainer.as_fine(made, state), state, history[-1] | {"why": "learnt"}
        update = jit(trainer.as_fine(made, state).update, donate=True)
    else:
        taught = None if config.init_from is None else warm_start.read(made, config.init_from)
        _claim(run)
        state, update = _begin(made)
        if taught is not None:
            state = warm_start.begin(state, taught)
    checkpoint.write_config(run, config)
    with _stop_signal() as stopped:
        state, last = _loop(made, update, run, state, history, begin, report, stopped)
    return trainer.as_fine(made, state), state, last


def _begin(made: Trainer) -> tuple[TrainState, Callable[..., Any]]:
    """Returns the first state, and `update` compiled."""
    key = jax.random.key(made.config.seed)
    init = jit(made.init).lower(key)
    if made.world is not None:
        state = init.compile()(key)
        return state, jit(made.update, donate=True).lower(state, made.world(state)).compile()
    with ThreadPoolExecutor(1) as pool:  # both at the same time: a person waits for them
        compiled = pool.submit(init.compile)
        update = jit(made.update, donate=True).lower(init.out_info).compile()
        return compiled.result()(key), update


def _loop(
    made: Trainer,
    update: Callable[..., Any],
    run: Path,
    state: TrainState,
    history: list[dict[str, Any]],
    begin: float,
    report: Report,
    stopped: Callable[[], bool],
) -> tuple[TrainState, dict[str, Any]]:
    config = made.config
    judge = judge_lib.make(made)
    before = history[-1]["wall_s"] if history else 0.0
    saved, fine = time.monotonic(), bool(state.refinement.fine)
    samples, sums, why = int(state.samples), [], ""
    last: dict[str, Any] = {"samples": samples, "wall_s": before}
    if history:
        last = history[-1]
    with (run / "metrics.jsonl").open("a") as lines, SummaryWriter(str(run)) as board:
        while not why:
            if samples >= config.samples:
                why = "samples used up"
            elif stopped():
                why = "interrupted"
            else:
                around = () if made.world is None else (made.world(state),)
                state, metrics = update(state, *around)
                samples += made.samples
                sums.append(jax.device_get(metrics))
                if sums[-1].get("fine", False) and not fine:
                    update, fine = jit(trainer.refined(made).update, donate=True), True
            first = "survival_s" not in last
            many = 1 if made.world else _LOG_UPDATES  # an update of a family takes seconds
            if sums and (len(sums) == many or why or first):
                last = line(made, sums, samples, before + time.monotonic() - begin)
                sums = []
                if not first:  # few episodes have ended yet, so their mean says nothing
                    last |= judge(state, last)
                if judge.learnt:
                    why = "learnt"
                    last["learnt"] = True
                lines.write(json.dumps(last) + "\n")
                lines.flush()
                _to_board(board, last)
                report(last)
            if why or time.monotonic() - saved > SAVE_SECONDS:
                checkpoint.save(run, state, samples)
                saved = time.monotonic()
    return state, last | {"why": why}


def line(
    made: Trainer, metrics: list[dict[str, np.ndarray]], samples: int, wall: float
) -> dict[str, Any]:
    """Returns one line of metrics.jsonl: sums and means over a few updates.

    `survival_s` is the mean time between failures, which does not depend on when episodes are cut
    off. Without a failure it is the time that was simulated.
    """
    total = {name: sum(m[name] for m in metrics) for name in metrics[0]}
    count = len(metrics)
    endings = np.asarray(total["endings"])
    ended: dict[str, Any] = {}
    by_cause = zip(made.env.endings, endings.astype(int).tolist(), strict=True)
    if endings.any():
        ended["endings"] = {name: counts for name, counts in by_cause if any(counts)}
        cause, place = np.unravel_index(endings.argmax(), endings.shape)
        ended["worst_bound"] = made.env.endings[cause]
        ended["worst_phase"] = round((float(place) + 0.5) / endings.shape[1], 3)
    for name, times in zip(made.env.endings, endings.sum(1), strict=True):
        if times:
            ended[f"ended/{name}"] = round(float(times / endings.sum()), 4)
    return {
        "samples": samples,
        "wall_s": round(wall, 2),
        "survival_s": float(total["steps"] / max(total["failures"], 1.0) * CONTROL_DT),
        "reward": float(total["reward"] / count),
        "kl": float(total["kl"] / count),
        "clipped": float(total["clipped"] / count),
        "value_loss": float(total["value_loss"] / count),
        "policy_lr": float(total["policy_lr"] / count),
        "diverged": int(total["diverged"]),
        **({"fine": True} if metrics[-1].get("fine", False) else {}),
        **{k: np.asarray(v).item() for k, v in metrics[-1].items() if k in family.WATCHED},
        **({"bound_scale": float(metrics[-1]["bound_scale"])} if "bound_scale" in total else {}),
        **ended,
    }


def _to_board(board: SummaryWriter, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if isinstance(value, int | float) and name != "samples":
            board.add_scalar(name, value, values["samples"])


def _claim(run: Path) -> None:
    """Makes the run folder, which must not hold anything yet."""
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        raise UserError(f"'{run}' exists: give --resume to go on with it, or another --out")
    run.mkdir(parents=True, exist_ok=True)


def _rewind(run: Path, samples: int) -> list[dict[str, Any]]:
    """Returns the metrics up to the checkpoint and drops the lines after it from the file."""
    path = run / "metrics.jsonl"
    lines = path.read_text().splitlines() if path.is_file() else []
    kept = []
    for text in lines:
        try:
            row = json.loads(text)
        except json.JSONDecodeError:
            break  # the line that a kill cut off
        if row["samples"] > samples:
            break
        kept.append(row)
    if len(kept) < len(lines):
        shutil.copy(path, path.with_suffix(".jsonl.bak"))
        paths.write_whole(path, "".join(json.dumps(row) + "\n" for row in kept))
    return kept


@contextmanager
def _stop_signal() -> Iterator[Callable[[], bool]]:
    """Yields whether Ctrl-C was pressed; a second press interrupts at once."""
    pressed = False

    def press(number: int, frame: Any) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    try:
        previous = signal.signal(signal.SIGINT, press)
    except ValueError:  # not the main thread: a notebook's job, say
        yield lambda: False
        return
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, previous)
