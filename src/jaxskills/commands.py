# SPDX-License-Identifier: Apache-2.0
"""What each command does: from its arguments to an answer, as text and as data."""

import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxskills import (
    arguments,
    check,
    checkpoint,
    clip,
    evaluate_family,
    paths,
    physics,
    playback,
    playback_family,
    plot,
    progress,
    recipes,
    render,
    runs,
    style_measures,
    task_values,
)
from jaxskills import character as character_lib
from jaxskills import evaluate as evaluate_lib
from jaxskills import perform as perform_lib
from jaxskills import retarget as retarget_lib
from jaxskills import train as train_lib
from jaxskills.env import bounds_file
from jaxskills.env.bounds import BoundsConfig
from jaxskills.errors import UserError, unknown
from jaxskills.plot import family as family_plot
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, Trainer, TrainState


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
    physics.configure_cpu(getattr(settings or command, "backend", "auto"))
    match command:
        case arguments.Train():
            return train(command, settings)
        case arguments.Evaluate():
            return evaluate(command)
        case arguments.Render():
            return film(command)
        case arguments.Plot():
            return picture(command)
        case arguments.Bounds():
            return bounds(command)
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
    task = recipe.source if recipe.task is not None else ""
    whole = dataclasses.replace(config, clip=recipe.clip, character=recipe.character, task=task)
    return _located(whole)


def settings_of(command: arguments.Train, config: TrainConfig) -> TrainConfig:
    """Returns the settings that the options change: the recipe's, or the resumed run's.

    Args:
      command: says which.
      config: the recipe's settings with the options.

    Raises:
      UserError: there is no such run, it learns another clip, or the bounds file is bad.
    """
    if not command.resume:
        found, character = settings(recipes.find(command.skill)), config.character
    else:
        found = checkpoint.read_config(command.out)
        character = found.character
        if found.clip != _absolute(config.clip):
            raise UserError(
                f"run '{command.out}' learns '{found.clip}', not '{config.clip}':"
                " give another --out"
            )
    if command.bounds_file is None:
        return found
    sizes = bounds_file.read(command.bounds_file, character_lib.load(character))
    return dataclasses.replace(found, bounds=sizes)


def train(command: arguments.Train, config: TrainConfig) -> Answer:
    """Learns, then films the result into the run folder."""
    config = _located(config)
    run, name = command.out, recipes.find(command.skill).name
    done = max(checkpoint.existing(run), default=0) if command.resume else 0
    print(f"{name}: compiling, which takes half a minute the first time", file=sys.stderr)
    with progress.live(name, config.samples, done) as report, _enough_memory(config):
        made, state, last = train_lib.train(config, run, report, command.resume)
    if last["why"] == "interrupted":
        text = f"interrupted: {last['samples']} samples are saved in '{run}', --resume goes on"
        return Answer(text, last, interrupted=True)
    lines = [f"{name}: {last['why']} after {last['samples']} samples, {last['wall_s']:.0f} s"]
    film_into = _filmed(made, state)
    for path in (run / f"{name}.mp4", run / f"{name}.png"):
        try:
            lines.append(f"wrote {film_into(path)}")
        except UserError as error:  # nothing to draw with: the controller is there all the same
            lines.append(f"no {path.name}: {error}")
    return Answer("\n".join(lines), last)


def _filmed(made: Trainer, state: TrainState) -> Callable[[Path], Path]:
    """Returns what films a run into a file, of a family a grid over its task parameters."""
    if made.task is None:
        return lambda path: playback.film(made, state, path, seconds=10.0)
    wanted = playback_family.wanted(made, state, None)
    cells = playback_family.cells(made, state, wanted)
    return lambda path: playback_family.film(cells, path)


def evaluate(command: arguments.Evaluate) -> Answer:
    """Measures the controller of a run."""
    if command.style_clip is not None:
        clip.find(command.style_clip)  # a mistake is said at once
    made, state = runs.open_run(command.run, command.backend)
    if made.task is not None:
        return _evaluate_family(command, made, state)
    config = evaluate_lib.EvaluateConfig(
        seconds=20.0 if command.seconds is None else command.seconds,
        episodes=32 if command.episodes is None else command.episodes,
        substeps=command.substeps,
        seed=command.seed,
    )
    trace = playback.play(made, state, config)
    data = {
        **evaluate_lib.summary(trace),
        **evaluate_lib.accuracy(made.character, trace),
        "samples": int(state.samples),
        **dataclasses.asdict(config),
        "substeps": config.substeps or made.config.env.substeps,
        **style_measures.style_measures(made, trace, command.style_clip),
    }
    data = {key: value for key, value in data.items() if value is not None}
    lines = [f"{key:28} {value:.4g}" for key, value in data.items()]
    return Answer("\n".join(lines), data)


def _evaluate_family(command: arguments.Evaluate, made: Trainer, state: TrainState) -> Answer:
    for name, value in (("seconds", command.seconds), ("style-clip", command.style_clip)):
        if value is not None:
            raise UserError(
                f"--{name} is {value}: this run is of a family, which performs its motion once for"
                f" each task parameter: leave --{name} out"
            )
    config = evaluate_family.FamilyEvaluateConfig(substeps=command.substeps, seed=command.seed)
    if command.episodes is not None:
        config = dataclasses.replace(config, episodes=command.episodes)
    a = evaluate_family.parameters(made, config)
    done = perform_lib.perform(made, state, a, config.substeps)
    data = {
        **evaluate_family.summary(made, state, done),
        "samples": int(state.samples),
        "seed": config.seed,
        "substeps": config.substeps or made.config.env.substeps,
    }
    return Answer("\n".join(evaluate_family.lines(data)), data)


def film(command: arguments.Render) -> Answer:
    """Films the controller of a run beside its reference."""
    _admit(command.out, render.FORMATS)
    if command.task:
        _check_task(command)  # a mistake is said at once
    made, state = runs.open_run(command.run, command.backend)
    if made.task is not None:
        wanted = playback_family.wanted(made, state, command.task)
        cells = playback_family.cells(made, state, wanted, command.seconds)
        path = playback_family.film(cells, command.out)
    else:
        path = playback.film(made, state, command.out, command.seconds)
    return Answer(f"wrote {path}", {"out": str(path)})


def _check_task(command: arguments.Render) -> None:
    skill = checkpoint.read_config(command.run).task
    if not skill:
        raise UserError(f"--task is {command.task[0]}: this run is of one skill: leave it out")
    spec = recipes.task(skill)
    task_values.parse(spec, np.zeros(len(spec.free)), command.task)


def picture(command: arguments.Plot) -> Answer:
    """Plots the training of a run, and what its controller does."""
    _admit(command.out, plot.FORMATS)
    made, state = runs.open_run(command.run)
    metrics = _metrics(command.run / "metrics.jsonl")
    title = f"{Path(made.config.clip).stem} on {made.character.name}"
    if made.task is not None:
        a = evaluate_family.parameters(made, evaluate_family.FamilyEvaluateConfig())
        done = perform_lib.perform(made, state, a)
        seen = playback_family.explored(made, state), playback_family.asked(made, done)
        path = family_plot.figure(command.out, f"family of {title}", metrics, *seen)
        return Answer(f"wrote {path}", {"out": str(path)})
    trace = playback.play(made, state, evaluate_lib.EvaluateConfig())
    path = plot.figure(
        command.out, title, metrics, playback.played(made, trace), playback.evolved(made, state)
    )
    return Answer(f"wrote {path}", {"out": str(path)})


def bounds(command: arguments.Bounds) -> Answer:
    """Writes the default bounds of a character."""
    _admit(command.out, bounds_file.SUFFIXES)
    character = character_lib.load(command.character)
    bounds_file.write(command.out, character, BoundsConfig())
    return Answer(f"wrote {command.out}", {"out": str(command.out)})


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


def _metrics(path: Path) -> list[dict[str, Any]]:
    """Returns the lines of a metrics.jsonl, up to one that a kill cut off."""
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows


def _located(config: TrainConfig) -> TrainConfig:
    """Returns the settings with the full path of every file they name."""
    style = config.env.style
    files = {
        name: None if value is None else _absolute(value)
        for name, value in (("style_clip", style.style_clip), ("autoencoder", style.autoencoder))
    }
    env = dataclasses.replace(config.env, style=dataclasses.replace(style, **files))
    files = {name: _absolute(getattr(config, name)) for name in ("clip", "character")}
    begin = None if config.init_from is None else str(Path(config.init_from).absolute())
    return dataclasses.replace(config, env=env, init_from=begin, **files)


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
        paths.deepmimic_dirs()
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
