# SPDX-License-Identifier: Apache-2.0
"""The loop that a person starts: it learns, writes lines, and survives being stopped."""

import dataclasses
import json
import shutil
import signal
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, clip, train, trainer
from jaxskills.errors import UserError
from jaxskills.learn.networks import NetworkConfig
from jaxskills.learn.ppo import PPOConfig
from jaxskills.trainer import TrainConfig, TrainState

STEP = 32  # samples in an update of `config`


pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> TrainConfig:
    folder = tmp_path_factory.mktemp("walker")
    return tiny.train_config(folder, samples=12 * STEP, stop_when_learnt=False)


def _quiet(metrics: Any) -> None:
    pass


def _lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(text) for text in (run / "metrics.jsonl").read_text().splitlines()]


def _samples(run: Path) -> list[int]:
    return [line["samples"] for line in _lines(run)]


def _assert_same_bits(a: TrainState, b: TrainState):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        x, y = (jax.random.key_data(z) if is_key else z for z in (x, y))
        np.testing.assert_array_equal(x, y)


def _refused(*arguments: Any, **named: Any) -> str:
    with pytest.raises(UserError) as raised:
        train.train(*arguments, **named)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_run_writes_its_settings_lines_events_and_state(config: TrainConfig, tmp_path: Path):
    shown = []
    made, state, last = train.train(config, tmp_path, shown.append)
    assert (last["why"], last["samples"]) == ("samples used up", 12 * STEP)
    assert int(state.updates) == 12
    assert checkpoint.read_config(tmp_path) == config
    assert checkpoint.existing(tmp_path) == [12 * STEP]
    _assert_same_bits(checkpoint.restore(tmp_path, made), state)
    assert list(tmp_path.glob("events.out.tfevents.*"))
    lines = _lines(tmp_path)
    assert lines == shown
    assert _samples(tmp_path) == [STEP, 6 * STEP, 11 * STEP, 12 * STEP]  # the first at once
    for line in lines:
        assert {"samples", "wall_s", "survival_s"} <= set(line)
        assert 0.0 < line["survival_s"] < 10.0
        shares = [value for name, value in line.items() if name.startswith("ended/")]
        assert bool(shares) == ("worst_bound" in line)  # in one update nothing need have ended
        assert not shares or sum(shares) == pytest.approx(1.0, abs=1e-3)
        counts = {name: sum(row) for name, row in line.get("endings", {}).items()}
        assert {len(row) for row in line.get("endings", {}).values()} <= {trainer.PHASE_BINS}
        for name, count in counts.items():
            assert line[f"ended/{name}"] == pytest.approx(count / sum(counts.values()), abs=1e-4)
    assert "worst_bound" in lines[1]
    walls = [line["wall_s"] for line in lines]
    assert walls == sorted(walls)


def test_a_resumed_run_goes_on_where_it_stopped(config: TrainConfig, tmp_path: Path):
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    _, expected, _ = train.train(dataclasses.replace(config, samples=20 * STEP), straight, _quiet)
    train.train(config, stopped, _quiet)
    before = _lines(stopped)
    longer = dataclasses.replace(config, samples=20 * STEP)
    _, state, last = train.train(longer, stopped, _quiet, resume=True)
    _assert_same_bits(state, expected)
    assert (last["samples"], last["why"]) == (20 * STEP, "samples used up")
    lines = _lines(stopped)
    assert lines[: len(before)] == before
    assert _samples(stopped) == [STEP * n for n in (1, 6, 11, 12, 17, 20)]
    assert all(a["wall_s"] <= b["wall_s"] for a, b in zip(lines, lines[1:], strict=False))
    assert checkpoint.read_config(stopped).samples == 20 * STEP


def test_resuming_a_finished_run_keeps_what_was_known(config: TrainConfig, tmp_path: Path):
    _, state, before = train.train(config, tmp_path, _quiet)
    lines = _lines(tmp_path)
    _, again, last = train.train(config, tmp_path, _quiet, resume=True)
    _assert_same_bits(again, state)
    assert _lines(tmp_path) == lines
    assert (last["why"], last["samples"]) == ("samples used up", 12 * STEP)
    assert last["survival_s"] == before["survival_s"]


def test_lines_after_the_checkpoint_are_told_once(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As after a kill: the newest state is behind the metrics, whose last line is cut off."""
    monkeypatch.setattr(train, "SAVE_SECONDS", 0.0)
    train.train(config, tmp_path, _quiet)
    assert checkpoint.existing(tmp_path) == [11 * STEP, 12 * STEP]
    shutil.rmtree(tmp_path / "checkpoints" / f"{12 * STEP:012d}")
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"samples": 99')
    train.train(config, tmp_path, _quiet, resume=True)
    assert _samples(tmp_path) == [STEP, 6 * STEP, 11 * STEP, 12 * STEP]  # the first at once
    assert len((tmp_path / "metrics.jsonl.bak").read_text().splitlines()) == 5


def test_a_damaged_newest_checkpoint_is_refused_and_the_one_before_serves(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(train, "SAVE_SECONDS", 0.0)
    train.train(config, tmp_path, _quiet)
    newest = tmp_path / "checkpoints" / f"{12 * STEP:012d}"
    for file in newest.rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:10])
    lines = _lines(tmp_path)
    message = _refused(config, tmp_path, _quiet, resume=True)
    assert message.startswith(f"checkpoint '{newest}' is damaged")
    assert message.endswith(f"remove it to fall back on {11 * STEP} samples")
    assert _lines(tmp_path) == lines
    shutil.rmtree(newest)
    _, state, _ = train.train(config, tmp_path, _quiet, resume=True)
    assert int(state.updates) == 12


def test_a_folder_in_use_is_refused_and_left_alone(config: TrainConfig, tmp_path: Path):
    (tmp_path / "thesis.txt").write_text("mine")
    assert _refused(config, tmp_path, _quiet) == (
        f"'{tmp_path}' exists: give --resume to go on with it, or another --out"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert "exists" in _refused(config, tmp_path / "thesis.txt", _quiet)


def test_a_full_disk_costs_nothing_that_was_saved(
    config: TrainConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made, state, _ = train.train(config, tmp_path, _quiet)
    longer = dataclasses.replace(config, samples=20 * STEP)
    free = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free)
    with pytest.raises(OSError, match="No space left on device"):
        train.train(longer, tmp_path, _quiet, resume=True)
    assert checkpoint.existing(tmp_path) == [12 * STEP]
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == [f"{12 * STEP:012d}"]
    _assert_same_bits(checkpoint.restore(tmp_path, made), state)


def test_what_was_never_begun_cannot_be_resumed(config: TrainConfig, tmp_path: Path):
    assert "holds no checkpoint yet" in _refused(config, tmp_path, _quiet, resume=True)
    assert list(tmp_path.iterdir()) == []


def test_the_first_ctrl_c_saves_and_stops(config: TrainConfig, tmp_path: Path):
    before = signal.getsignal(signal.SIGINT)
    endless = dataclasses.replace(config, samples=10**9)
    _, state, last = train.train(
        endless, tmp_path, lambda metrics: signal.raise_signal(signal.SIGINT)
    )
    assert (last["why"], last["samples"], int(state.updates)) == ("interrupted", STEP, 1)
    assert checkpoint.existing(tmp_path) == [STEP]
    assert signal.getsignal(signal.SIGINT) is before


def test_the_second_ctrl_c_stops_at_once(config: TrainConfig, tmp_path: Path):
    def twice(metrics: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train.train(config, tmp_path, twice)
    assert signal.getsignal(signal.SIGINT) is before


def test_changed_sizes_of_an_update_are_no_way_to_go_back_in_samples(
    config: TrainConfig, tmp_path: Path
):
    """The samples of a run never go down, else its newest checkpoint would look old."""
    train.train(config, tmp_path, _quiet)
    shorter = dataclasses.replace(
        config, horizon=2, samples=14 * STEP, ppo=PPOConfig(epochs=2, minibatch=16)
    )
    try:
        _, state, last = train.train(shorter, tmp_path, _quiet, resume=True)
    except UserError:
        return
    assert last["samples"] >= 14 * STEP
    assert checkpoint.existing(tmp_path)[-1] == last["samples"]
    assert _samples(tmp_path) == sorted(_samples(tmp_path))
    assert _samples(tmp_path)[:4] == [STEP, 6 * STEP, 11 * STEP, 12 * STEP]


@pytest.mark.timeout(300)
def test_a_skill_that_stands_is_learnt_and_the_run_ends(config: TrainConfig, tmp_path: Path):
    walk = clip.load(config.clip)
    still = dataclasses.replace(
        walk,
        root_pos=np.tile([0.0, 0.0, 0.5], (31, 1)),
        rotations=np.tile([1.0, 0.0, 0.0, 0.0], (31, 3, 1)),
    )
    path = clip.save(still, tmp_path / "still.npz")
    easy = dataclasses.replace(
        config,
        clip=str(path),
        horizon=64,
        samples=10**7,
        stop_when_learnt=True,
        networks=NetworkConfig((16,), (16,), noise=0.01),
    )
    _, _, last = train.train(easy, tmp_path / "run", _quiet)
    assert last["why"] == "learnt"
    assert last["success_rate"] >= 0.95 and last["fine_success_rate"] >= 0.95
    assert last["seconds_mean"] > 18.0
    assert _lines(tmp_path / "run")[-1]["success_rate"] == last["success_rate"]
    assert checkpoint.existing(tmp_path / "run") == [last["samples"]]
    lines = _lines(tmp_path / "run")
    _, _, again = train.train(easy, tmp_path / "run", _quiet, resume=True)
    assert again == last and _lines(tmp_path / "run") == lines
    further = dataclasses.replace(easy, samples=last["samples"] + 1, stop_when_learnt=False)
    _, _, again = train.train(further, tmp_path / "run", _quiet, resume=True)
    assert again["samples"] > last["samples"] and again["why"] == "samples used up"
