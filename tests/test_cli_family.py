# SPDX-License-Identifier: Apache-2.0
"""The command line on a family: evaluate, render and plot, and what they refuse."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import tiny_family
from PIL import Image

from jaxskills import arguments, checkpoint, commands, families
from jaxskills.cli import main
from jaxskills.errors import UserError
from jaxskills.render import opengl
from jaxskills.trainer import Trainer, TrainState

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trainer, TrainState]:
    made = families.make(tiny_family.config(tmp_path_factory.mktemp("walks")))
    return made, tiny_family.trained(made)


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_family.write_run(tmp_path_factory.mktemp("runs") / "walks", *trained)


def _refused(capsys: Capture, *typed: str | Path) -> str:
    assert main([str(word) for word in typed]) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    return err


def test_evaluate_prints_one_json_object(run: Path, capfd: Capture):
    assert main(["evaluate", str(run), "--episodes", "3", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    names = {"success_rate", "seconds_mean", "inside_bounds_rate", "episodes", "samples"}
    assert names <= set(found)
    assert (found["episodes"], found["samples"], found["training_episodes"]) == (3, 4096, 1234)
    assert len(found["performances"]) == 3 and 0.0 < found["explored"] < 0.1
    assert set(found["errors"]) == {"height"}


def test_evaluate_for_people(run: Path, capsys: Capture):
    assert main(["evaluate", str(run), "--episodes", "3"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert any(row.startswith("success_rate ") for row in rows)
    assert any(row.startswith("error of height ") for row in rows)
    assert any(row.startswith("explored gravity ") for row in rows)
    assert not any("performances" in row for row in rows)


def test_plot_writes_a_picture(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    few = lambda made, config: np.full((3, 2), 0.5, np.float32)  # noqa: E731
    monkeypatch.setattr(commands.evaluate_family, "parameters", few)
    file = tmp_path / "walks.png"
    assert main(["plot", str(run), "--out", str(file)]) == 0
    with Image.open(file) as page:
        assert page.width == 1650


def test_render_writes_a_strip(run: Path, tmp_path: Path):
    try:
        opengl.backend()
    except UserError as missing:
        pytest.skip(str(missing))
    file = tmp_path / "walks.png"
    typed = ["render", str(run), "--out", str(file), "--task", "height=0.7,1,1.2", "gravity=1"]
    assert main([*typed, "--seconds", "0.4"]) == 0
    with Image.open(file) as strip:
        assert np.asarray(strip.convert("L")).std() > 5


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ("evaluate RUN --seconds 3", "--seconds is 3.0: this run is of a family, which performs"),
        ("evaluate RUN --style-clip walking", "clip 'walking'"),
        ("evaluate RUN --style-clip pivot", "--style-clip is pivot: this run is of a family"),
        ("evaluate RUN --episodes 0", "episodes is 0: give 1 to 65536"),
        ("evaluate RUN --substeps 0", "env.substeps is 0: give 1 to 100"),
        ("render RUN --out a.mp4 --task speed=1", "'speed': choose one of height, gravity"),
        ("render RUN --out a.mp4 --task height=1.6", "height is 1.6: give 0.5 to 1.5"),
        ("render RUN --out a.mp4 --task height=low", "height is 'low': give it a number"),
    ],
)
def test_what_is_refused_in_one_line(
    typed: str,
    says: str,
    run: Path,
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    assert says in _refused(capsys, *(run if word == "RUN" else word for word in typed.split()))
    assert not list(tmp_path.iterdir())


def test_a_skill_takes_no_task(trained, tmp_path: Path):
    checkpoint.write_config(tmp_path, dataclasses.replace(trained[0].config, task=""))
    command = arguments.Render(tmp_path, tmp_path / "a.mp4", task=("height=1",))
    with pytest.raises(UserError, match="--task is height=1: this run is of one skill"):
        commands.film(command)


def test_a_finished_training_is_filmed_as_a_grid(
    run: Path, trained, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
):
    """What training does is tested elsewhere; here it is over at once."""
    seen = []
    last = tiny_family.line(3) | {"why": "samples used up"}
    monkeypatch.setattr(commands.train_lib, "train", lambda *_: (*trained, last))
    monkeypatch.setattr(
        commands.playback_family, "cells", lambda made, state, wanted: wanted.a.shape
    )

    def film(cells: tuple[int, ...], path: Path) -> Path:
        seen.append((path.name, cells))
        return path

    monkeypatch.setattr(commands.playback_family, "film", film)
    recipe = Path(trained[0].config.task)
    assert main(["train", str(recipe), "--out", str(tmp_path / "run")]) == 0
    assert seen == [("walks.mp4", (3, 3, 2)), ("walks.png", (3, 3, 2))]
    assert "samples used up" in capsys.readouterr().out
