# SPDX-License-Identifier: Apache-2.0
"""What each command does: from its arguments to an answer, as text and as data."""

import contextlib
import dataclasses
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxskills import arguments, check, checkpoint, clip, paths, physics, progress, recipes, render
from jaxskills import character as character_lib
from jaxskills import evaluate as evaluate_lib
from jaxskills import motion as motion_lib
from jaxskills import retarget as retarget_lib
from jaxskills import train as train_lib
from jaxskills import trainer as trainer_lib
from jaxskills.compilation import jit
from jaxskills.errors import UserError, unknown
from jaxskills.motion import CONTROL_DT
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, Trainer, TrainState

_AFTER_FALL = 1.0  # s of film after the character has fallen


@dataclasses.dataclass(frozen=True)
class Answer:
    """What a command says."""

    text: str  # for people
    data: dict[str, Any]  # for --json
    interrupted: bool = False


def perform(command: Any, settings: Any) -> Answer:
    """Returns the answer of a command, one of `arguments`; `settings` are those of `train`.

    Raises:
      UserError: bad input.
    """
    physics.configure_cpu()
    match command:
        case arguments.Train():
            return train(command, settings)
        case arguments.Evaluate():
            return evaluate(command)
        case arguments.Render():
            return film(command)
        case arguments.ClipsList():
            return clips_list()
        case arguments.ClipsCheck():
            return clips_check(command)
        case arguments.ClipsShow():
            return clips_show(command)
    raise TypeError(f"no command {command}")


def settings(recipe: Recipe | None) -> TrainConfig:
    """Returns the settings of a recipe, or the default ones."""
    if recipe is None:
        return TrainConfig()
    config = recipe.config or TrainConfig()
    return dataclasses.replace(
        config, clip=_absolute(recipe.clip), character=_absolute(recipe.character)
    )


def settings_of(command: arguments.Train) -> TrainConfig:
    """Returns the settings that the options change: the recipe's, or the resumed run's.

    Raises:
      UserError: there is no such run, or it learns something else.
    """
    fresh = settings(recipes.find(command.skill))
    if not command.resume:
        return fresh
    saved = checkpoint.read_config(command.out)
    if (saved.clip, saved.character) != (fresh.clip, fresh.character):
        raise UserError(
            f"run '{command.out}' learns '{saved.clip}' on '{saved.character}', not"
            f" '{fresh.clip}' on '{fresh.character}': give another --out"
        )
    return saved


def train(command: arguments.Train, config: TrainConfig) -> Answer:
    """Learns, then films the result into the run folder."""
    config = dataclasses.replace(
        config, clip=_absolute(config.clip), character=_absolute(config.character)
    )
    run, name = command.out, recipes.find(command.skill).name
    done = max(checkpoint.existing(run), default=0) if command.resume else 0
    print(f"{name}: compiling, which takes a minute or two the first time", file=sys.stderr)
    with progress.live(name, config.samples, done) as report, _enough_memory(config):
        made, state, last = train_lib.train(config, run, report, command.resume)
    if last["why"] == "interrupted":
        text = f"interrupted: {last['samples']} samples are saved in '{run}', --resume goes on"
        return Answer(text, last, interrupted=True)
    lines = [f"{name}: {last['why']} after {last['samples']} samples, {last['wall_s']:.0f} s"]
    for path in (run / f"{name}.mp4", run / f"{name}.png"):
        try:
            lines.append(f"wrote {_film(made, state, path, seconds=10.0)}")
        except UserError as error:  # nothing to draw with: the controller is there all the same
            lines.append(f"no {path.name}: {error}")
    return Answer("\n".join(lines), last)


def evaluate(command: arguments.Evaluate) -> Answer:
    """Measures the controller of a run."""
    made, state = _open(command.run, command.backend)
    config = evaluate_lib.EvaluateConfig(
        command.seconds, command.episodes, command.substeps, command.seed
    )
    trace = jit(evaluate_lib.make(made, config))(state, jax.random.key(command.seed))
    data = {
        **evaluate_lib.summary(trace),
        "samples": train_lib.samples_of(made.config, state),
        **dataclasses.asdict(config),
        "substeps": config.substeps or made.config.env.substeps,
    }
    lines = [f"{key:20} {value:.4g}" for key, value in data.items()]
    return Answer("\n".join(lines), data)


def film(command: arguments.Render) -> Answer:
    """Films the controller of a run beside its reference."""
    _admit(command.out, render.FORMATS)
    made, state = _open(command.run, command.backend)
    path = _film(made, state, command.out, command.seconds)
    return Answer(f"wrote {path}", {"out": str(path)})


def _open(run: Path, backend: str) -> tuple[Trainer, TrainState]:
    """Returns a trained run, on a backend of this machine instead of the one it learnt on."""
    config: Any = dataclasses.replace(checkpoint.read_config(run), backend=backend)
    made = trainer_lib.make(config)
    return made, checkpoint.restore(run, made)


def _film(made: Trainer, state: TrainState, path: Path, seconds: float) -> Path:
    """Films one episode, until shortly after a fall."""
    config = evaluate_lib.EvaluateConfig(seconds, episodes=1)
    trace = jit(evaluate_lib.make(made, config))(state, jax.random.key(config.seed))
    qpos, phase = np.asarray(trace.qpos[:, 0]), trace.phase[:, 0]
    ended = np.asarray(trace.fallen[:, 0])
    last = (ended.argmax() if ended.any() else len(qpos)) + round(_AFTER_FALL / CONTROL_DT)
    layout = made.character.layout
    at = jax.vmap(lambda p: motion_lib.sample(layout, made.motion, p)[0])
    reference = np.asarray(jit(at)(phase))
    cycle = made.motion.seconds if made.motion.loop else None
    fps = 1.0 / CONTROL_DT
    return render.film(made.character, qpos[:last], reference[:last], path, fps=fps, cycle=cycle)


@contextlib.contextmanager
def _enough_memory(config: TrainConfig) -> Iterator[None]:
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise UserError(
            f"envs is {config.envs}, horizon {config.horizon}: too many for the memory, give fewer"
        ) from None


def _absolute(name: str) -> str:
    """Returns the full path of a file, so that a run can be used from another folder."""
    return str(Path(name).absolute()) if Path(name).is_file() else name


def clips_list() -> Answer:
    """Returns the clips that are known by name."""
    rows = []
    for name in clip.available():
        one = clip.load(name)
        row = {"name": name, "seconds": one.duration, "frames": len(one.times), "loop": one.loop}
        rows.append(row)
    lines = [
        f"{row['name']:24} {row['seconds']:6.2f} s {row['frames']:5} frames"
        f"  {'loops' if row['loop'] else 'does not loop'}"
        for row in rows
    ]
    try:
        paths.deepmimic_dir()
    except UserError as missing:
        lines.append(str(missing))
    return Answer("\n".join(lines), {"clips": rows})


def clips_check(command: arguments.ClipsCheck) -> Answer:
    """Returns what is wrong with a clip."""
    report = check.check(character_lib.load(command.character), clip.load(command.file))
    return Answer(check.format_report(report), report.as_dict())


def clips_show(command: arguments.ClipsShow) -> Answer:
    """Films a clip on a character, without physics."""
    _admit(command.out, render.FORMATS)
    character = character_lib.load(command.character)
    shown = clip.load(command.file)
    qpos = retarget_lib.retarget(character, shown)
    path = render.film(character, qpos, None, command.out, fps=shown.rate)
    return Answer(f"wrote {path}", {"out": str(path)})


def _admit(path: Path, suffixes: Iterable[str]) -> None:
    """Raises UserError if `path` cannot be written, before any work is done for it."""
    if path.suffix.lower() not in suffixes:
        raise unknown("file format", path.name, suffixes)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UserError(f"cannot write '{path}': name a file in a folder of yours")
