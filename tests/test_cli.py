# SPDX-License-Identifier: Apache-2.0
"""The command line: what it refuses, in one line each, and a small run from end to end."""

import errno
import hashlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, commands, progress, trainer
from jaxskills.cli import main
from jaxskills.env.bounds import BoundsConfig
from jaxskills.trainer import TrainConfig

SMALL = (
    *("--envs", "8", "--horizon", "4", "--samples", "64", "--backend", "cpu"),
    *("--ppo.minibatch", "16", "--ppo.epochs", "1"),
    *("--networks.policy", "16", "--networks.value", "16"),
)

GRAM = "--env.reward style --env.style.style gram"

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def walker(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The arguments that train the walker of four bodies."""
    folder = tmp_path_factory.mktemp("walker")
    character, clip = tiny.write_character(folder), tiny.write_clip(folder)
    return ["train", str(clip), "--character", str(character), *SMALL]


@pytest.fixture(scope="module")
def finished(walker: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, never changed; it has no film, as on a machine that cannot draw."""
    run = tmp_path_factory.mktemp("runs") / "finished"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "disable")
        assert main([*walker, "--out", str(run)]) == 0
    return run


def refused(capsys: Capture, *typed: str | Path) -> str:
    """The one line with which the command line refuses what was typed."""
    capsys.readouterr()
    code = main([str(word) for word in typed])
    out, err = capsys.readouterr()
    last = err.splitlines()[-1]
    assert (code, out) == (2, "")
    assert last.startswith("jaxskills: ") and "Traceback" not in err
    assert [row for row in err.splitlines() if "compiling" not in row] == [last]
    return last.removeprefix("jaxskills: ")


def digest(folder: Path) -> str:
    """What is in a folder, in short."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    parts = [str(path).encode() + path.read_bytes() for path in files]
    return hashlib.sha256(b"".join(parts)).hexdigest()


@pytest.mark.parametrize(
    ("typed", "says"),
    [
        ((), "Expected one of {train, evaluate, render, plot, bounds, clips}"),
        (("trian",), "trian; Available subcommands: train, evaluate, render, plot, bounds, clips"),
        (("clips", "sohw"), "sohw; Available subcommands: list, check, show"),
        (("evaluate",), "Missing from jaxskills evaluate: RUN"),
        (("evaluate", "run", "--secnods", "3"), "Perhaps you meant: --seconds"),
        (("evaluate", "run", "--seconds", "abc"), "--seconds: no type matching {None}|FLOAT"),
        (("evaluate", "run", "--backend", "gpu"), "('auto', 'cpu', 'mjx', 'warp')"),
        (("train",), "Missing from jaxskills train: SKILL"),
        (("train", "walk"), "Missing from jaxskills train: --out RUN"),
        (("train", "wlak", "--out", "run"), "unknown skill 'wlak': choose one of atlas_jump, "),
        (("train", "walk", "--out", "run", "--backend", "gpu"), "('auto', 'cpu', 'mjx', 'warp')"),
        (("train", "walk", "--out", "run", "--samples", "many"), "--samples: invalid literal"),
        (("train", "walk", "--out", "run", "--ppo.rate", "1"), "--ppo.rate"),
        (("train", "none.bvh", "--out", "run"), "clip 'none.bvh' does not exist"),
        (("train", "walk", "--out", "run", "--resume"), "'run' is not a run"),
        (("evaluate", "run"), "'run' is not a run"),
        (("evaluate", "run", "--style-clip", "wlak"), "unknown clip 'wlak': choose one of "),
        (("render", "run", "--out", "film.mp4"), "'run' is not a run"),
        (("render", "run", "--out", "film.avi"), "'film.avi': choose one of .mp4, .gif, .png"),
        (
            ("train", "walk", "--out", "run", "--bounds.file", "b.toml"),
            "file 'b.toml' does not exi",
        ),
        (("bounds", "--out", "b.txt"), "unknown file format 'b.txt': choose one of .toml"),
        (("bounds", "--out", "b.toml", "--character", "dog"), "unknown character 'dog'"),
        (("clips", "show", "walk", "--out", "film"), "'film': choose one of .mp4, .gif, .png"),
        (("clips", "check", "none.txt"), "clip 'none.txt' does not exist"),
        (("clips", "check", "walk", "--character", "dog"), "unknown character 'dog'"),
    ],
)
def test_mistyped(
    typed: tuple[str, ...],
    says: str,
    capsys: Capture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(tmp_path)
    assert says in refused(capsys, *typed)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("--envs 0", "envs is 0"),
        ("--samples -5", "samples is -5"),
        ("--seed -1", "seed is -1"),
        ("--env.substeps 100000", "env.substeps is 100000: give 1 to 100"),
        ("--env.seconds nan", "env.seconds is nan"),
        ("--bounds.joints -1", "is -1.0: give positive sizes"),
        ("--bounds.channels left_hipp 0.3", "unknown bound 'left_hipp': choose one of "),
        ("--networks.policy 0", "networks.policy is (0,)"),
        ("--ppo.discount 2", "ppo.discount is 2.0"),
        ("--ppo.policy-lr nan", "ppo.policy_lr is nan"),
        ("--starts.uniform 2", "starts.uniform is 2.0"),
        ("--character dog", "unknown character 'dog': choose one of "),
        ("--env.reward style --env.style.style gram", "style.style_clip is None: gram needs"),
        (f"{GRAM} --env.style.style-clip wlak", "unknown clip 'wlak': choose one of "),
        (f"{GRAM} --env.style.style-clip sparse_jog", "character 'walker' has others"),
        (
            f"{GRAM} --env.style.style-clip sparse_jog --env.style.autoencoder none.npz",
            "autoencoder 'none.npz' does not exist",
        ),
    ],
)
def test_settings_out_of_range(
    option: str, says: str, capsys: Capture, walker: list[str], tmp_path: Path
):
    run = tmp_path / "run"
    assert says in refused(capsys, *walker, "--out", run, *option.split())
    assert not run.exists()


def _deepmimic_walk(frames: int = 10) -> str:
    still = [0.1, *[0.0] * 3, *[1.0, 0.0, 0.0, 0.0] * 3, 0.0, *[1.0, 0.0, 0.0, 0.0]]
    frame = [*still, 0.0, *[1.0, 0.0, 0.0, 0.0] * 2, 0.0, 0.0, *[1.0, 0.0, 0.0, 0.0], 0.0]
    rows = [[*frame, *[0.0] * (44 - len(frame))] for _ in range(frames)]
    return json.dumps({"Loop": "wrap", "Frames": rows})


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.txt", ""),
        ("truncated.txt", _deepmimic_walk()[:-200]),
        ("nan.txt", _deepmimic_walk().replace("0.1", "NaN", 1)),
        ("short_frame.txt", json.dumps({"Loop": "wrap", "Frames": [[0.1] * 44, [0.1] * 43]})),
        ("one_frame.txt", _deepmimic_walk(frames=1)),
        ("empty.bvh", ""),
        ("empty.npz", ""),
    ],
)
@pytest.mark.parametrize("command", ["train", "check"])
def test_broken_clips(name: str, content: str, command: str, capsys: Capture, tmp_path: Path):
    file, run = tmp_path / name, tmp_path / "run"
    file.write_text(content)
    if command == "train":
        line = refused(capsys, "train", file, "--out", run, *SMALL)
    else:
        line = refused(capsys, "clips", "check", file)
    assert name in line
    assert not run.exists()


def test_clips_extra_missing(capsys: Capture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    find = importlib.util.find_spec
    monkeypatch.delenv("JAXSKILLS_CLIP_DIR", raising=False)
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "pybullet_data" else find(name)
    )
    run = tmp_path / "run"
    assert "pip install 'jaxskills[clips]'" in refused(capsys, "train", "walk", "--out", run)
    assert not run.exists()
    assert main(["clips", "list"]) == 0
    assert "pip install 'jaxskills[clips]'" in capsys.readouterr().out


def test_folder_that_cannot_be_written(capsys: Capture, walker: list[str], tmp_path: Path):
    file = tmp_path / "file"
    file.touch()
    assert str(file) in refused(capsys, *walker, "--out", file)
    assert str(file) in refused(capsys, *walker, "--out", file / "run")
    assert str(file) in refused(capsys, "clips", "show", "walk", "--out", file / "film.png")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_the_disk_refuses(number: int, capsys: Capture, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise OSError(number, "no room", None if number == errno.ENOSPC else "run/x")

    monkeypatch.setattr(commands, "perform", fail)
    assert "no room" in refused(capsys, "clips", "list")


def test_a_bug_is_not_called_bad_input(monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr(commands, "perform", fail)
    with pytest.raises(ValueError, match="a bug"):
        main(["clips", "list"])


def test_a_finished_run(finished: Path):
    rows = [json.loads(row) for row in (finished / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["samples"] == 64
    assert all({"samples", "wall_s", "survival_s"} <= set(row) for row in rows)
    assert checkpoint.existing(finished)[-1] == 64
    assert checkpoint.read_config(finished).envs == 8
    assert list(finished.glob("events.out.tfevents.*"))


def test_evaluate_prints_one_json_object(finished: Path, capfd: Capture):
    before = digest(finished)
    typed = ["evaluate", str(finished), "--seconds", "1", "--episodes", "4", "--json"]
    assert main(typed) == 0
    found = json.loads(capfd.readouterr().out)
    names = {"success_rate", "seconds_mean", "inside_bounds_rate", "episodes", "samples"}
    assert names <= set(found)
    assert (found["episodes"], found["samples"]) == (4, 64)
    assert 0 < found["seconds_mean"] <= 1
    assert found["energy_mean"] > 0 < found["reference_energy_mean"]
    assert found["volume_mean"] >= 0 <= found["reference_volume_mean"]
    assert digest(finished) == before


def test_plot_writes_a_picture(finished: Path, tmp_path: Path, capsys: Capture):
    file = tmp_path / "new" / "walk.svg"
    assert main(["plot", str(finished), "--out", str(file)]) == 0
    assert f"wrote {file}" in capsys.readouterr().out
    assert file.read_text().startswith("<?xml")


def test_a_run_is_not_overwritten(finished: Path, walker: list[str], capsys: Capture):
    before = digest(finished)
    assert "--resume" in refused(capsys, *walker, "--out", finished)
    assert digest(finished) == before


def test_another_skill_does_not_resume(finished: Path, capsys: Capture):
    before = digest(finished)
    line = refused(capsys, "train", "sparse_jog", "--out", finished, "--resume")
    assert "walking.npz" in line and "sparse_jog" in line
    assert digest(finished) == before


def test_ctrl_c_saves_and_resume_goes_on(
    walker: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        press = lambda *_: signal.raise_signal(signal.SIGINT)  # noqa: E731
        patch.setattr(progress, "line", lambda *_: str(press()))
        assert main([*walker, "--out", str(run), "--samples", "1000000"]) == 130
    assert "saved" in capsys.readouterr().out
    saved = checkpoint.existing(run)[-1]
    assert 0 < saved < 1_000_000
    more = ["--resume", "--samples", str(saved + 32)]
    assert main([*walker[:2], "--character", walker[3], "--out", str(run), *more]) == 0
    assert checkpoint.existing(run)[-1] == saved + 32
    assert checkpoint.read_config(run).envs == 8


def test_bounds_of_a_file(
    walker: list[str], tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
):
    """The run holds the sizes themselves; options win over the file, which is not overwritten."""

    def begin(config: TrainConfig, run: Path, *_: Any) -> tuple[None, None, dict[str, Any]]:
        trainer.make(config)
        run.mkdir(exist_ok=True)
        checkpoint.write_config(run, config)
        return None, None, {"why": "interrupted", "samples": 0}

    monkeypatch.setattr(commands.train_lib, "train", begin)
    file, run = tmp_path / "my.toml", tmp_path / "run"
    assert main(["bounds", "--character", walker[3], "--out", str(file)]) == 0
    assert "exists" in refused(capsys, "bounds", "--character", walker[3], "--out", file)
    text = (
        file.read_text().replace("joints = 0.7", "joints = 0.6").replace("root = 0.7", "root = 9")
    )
    file.write_text(text + "com_z = [[0.0, 0.2], [0.35, 0.5], [1.0, 0.2]]\n")
    learn = [*walker, "--out", str(run)]
    assert main([*learn, "--bounds.file", str(file), "--bounds.root", "0.5"]) == 130
    knots = ((0.0, 0.2), (0.35, 0.5), (1.0, 0.2))
    expected = BoundsConfig(joints=0.6, root=0.5, channels={"com_z": knots})
    assert checkpoint.read_config(run).bounds == expected
    assert str(file) not in (run / "config.json").read_text()
    # Resumed: without the file as it was, with another file as that says.
    file.write_text("joints = 0.4\n")
    assert main([*learn, "--resume"]) == 130
    assert checkpoint.read_config(run).bounds == expected
    assert main([*learn, "--resume", "--bounds.file", str(file)]) == 130
    assert checkpoint.read_config(run).bounds == BoundsConfig(joints=0.4)


def test_a_bounds_file_with_a_channel_that_is_not_there(
    walker: list[str], tmp_path: Path, capsys: Capture
):
    file = tmp_path / "my.toml"
    file.write_text("[channels]\nleft_hipp = 0.3\n")
    line = refused(capsys, *walker, "--out", tmp_path / "run", "--bounds.file", file)
    assert line.startswith(f"bounds file '{file}': unknown bound 'left_hipp': choose one of com_x")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("damage", ["cut", "gone", "config"])
def test_damaged_run(damage: str, finished: Path, tmp_path: Path, capsys: Capture):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    if damage == "gone":
        shutil.rmtree(run / "checkpoints")
    elif damage == "config":
        (run / "config.json").write_text('{"clip": ')
    else:
        newest = run / "checkpoints" / f"{checkpoint.existing(run)[-1]:012d}"
        for path in newest.rglob("*"):
            if path.is_file():
                path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert str(run) in refused(capsys, "evaluate", run, "--seconds", "1", "--episodes", "2")


def test_clips_check_prints_one_json_object(deepmimic: Path, capfd: Capture):
    assert main(["clips", "check", "walk", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["ok"] is True


def test_clips_list_as_json(deepmimic: Path, capfd: Capture):
    assert main(["clips", "list", "--json"]) == 0
    found = {row["name"]: row for row in json.loads(capfd.readouterr().out)["clips"]}
    assert found["walk"]["frames"] == 39
    np.testing.assert_allclose(found["walk"]["seconds"], 1.2667, atol=1e-3)


def test_options_may_stand_before_the_skill(capsys: Capture, tmp_path: Path):
    run = tmp_path / "run"
    assert "envs is 0" in refused(capsys, "train", "--envs", "0", "--out", run, "sparse_jog")


def test_help_needs_no_jax():
    """A real process; what it imported says whether help is quick."""
    script = (
        "import sys; from jaxskills.cli import main; code = main(['--help'])\n"
        "slow = {'jax', 'mujoco', 'scipy'} & set(sys.modules); print(slow, file=sys.stderr)\n"
        "sys.exit(code or bool(slow))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(
        name in done.stdout for name in ("train", "evaluate", "render", "plot", "bounds", "clips")
    )


def test_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "jaxskills", "trian"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and "trian" in done.stderr


def test_a_drawing_library_that_mujoco_does_not_know():
    """MuJoCo refuses it as it is imported, whatever is to be done."""
    done = subprocess.run(
        [sys.executable, "-m", "jaxskills", "clips", "list"],
        env=os.environ | {"MUJOCO_GL": "crayon"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and "MUJOCO_GL='crayon'" in done.stderr
