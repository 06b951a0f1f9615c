# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: what is kept, what is refused, and a configuration written and read."""

import dataclasses
import errno
import json
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from flax import struct

from jaxskills import checkpoint, trainer
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig
from jaxskills.errors import UserError
from jaxskills.explore.starts import StartsConfig
from jaxskills.learn.networks import NetworkConfig
from jaxskills.learn.ppo import PPOConfig
from jaxskills.motion import MotionConfig
from jaxskills.trainer import TrainConfig, Trainer, TrainState


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return trainer.make(tiny.train_config(tmp_path_factory.mktemp("walker")))


@pytest.fixture(scope="module")
def state(made: Trainer) -> TrainState:
    """A state of the right shapes, without the time that a real one takes to compile."""

    def fill(shape: jax.ShapeDtypeStruct) -> jax.Array:
        if jnp.issubdtype(shape.dtype, jax.dtypes.prng_key):
            return jax.random.key(3)
        return jnp.full(shape.shape, 2, shape.dtype)

    return jax.tree.map(fill, jax.eval_shape(made.init, jax.random.key(0)))


def _refused(run: Path, made: Trainer) -> str:
    with pytest.raises(UserError) as raised:
        checkpoint.restore(run, made)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_the_newest_two_are_kept(made: Trainer, state: TrainState, tmp_path: Path):
    for samples in (32, 64, 96):
        path = checkpoint.save(
            tmp_path, dataclasses.replace(state, updates=jnp.int32(samples)), samples
        )
        assert path == tmp_path / "checkpoints" / f"{samples:012d}"
    assert checkpoint.existing(tmp_path) == [64, 96]
    assert int(checkpoint.restore(tmp_path, made).updates) == 96


def test_saving_the_same_place_again_does_nothing(made: Trainer, state: TrainState, tmp_path: Path):
    checkpoint.save(tmp_path, state, 32)
    before = sorted(tmp_path.rglob("*"))
    checkpoint.save(tmp_path, state, 32)
    assert sorted(tmp_path.rglob("*")) == before


def test_half_written_checkpoints_are_not_seen(state: TrainState, tmp_path: Path):
    checkpoint.save(tmp_path, state, 32)
    (tmp_path / "checkpoints" / "000000000064.orbax-checkpoint-tmp").mkdir()
    (tmp_path / "checkpoints" / "000000000099").touch()
    assert checkpoint.existing(tmp_path) == [32]


def test_a_run_without_checkpoints_is_refused(made: Trainer, tmp_path: Path):
    assert (
        _refused(tmp_path, made) == f"run '{tmp_path}' holds no checkpoint yet: train it for longer"
    )


@pytest.mark.parametrize("earlier", [False, True])
def test_a_damaged_checkpoint_is_refused_in_one_line(
    made: Trainer, state: TrainState, tmp_path: Path, earlier: bool
):
    if earlier:
        checkpoint.save(tmp_path, state, 32)
    newest = checkpoint.save(tmp_path, state, 64)
    for file in newest.rglob("*"):
        if file.is_file():
            file.write_bytes(b"x")
    message = _refused(tmp_path, made)
    assert message.startswith(f"checkpoint '{newest}' is damaged or of other settings (")
    assert message.endswith("remove it to fall back on 32 samples" if earlier else "train anew")


def test_an_empty_checkpoint_is_refused(made: Trainer, tmp_path: Path):
    (tmp_path / "checkpoints" / "000000000064").mkdir(parents=True)
    assert "is damaged or of other settings" in _refused(tmp_path, made)


@pytest.mark.parametrize(
    "changes",
    [{"networks": NetworkConfig((8,), (16,))}, {"starts": StartsConfig(segments=7)}],
    ids=["layers", "segments"],
)
def test_a_checkpoint_of_other_settings_is_refused(
    made: Trainer, state: TrainState, tmp_path: Path, changes: dict
):
    checkpoint.save(tmp_path, state, 64)
    other = trainer.make(dataclasses.replace(made.config, **changes))
    assert "is damaged or of other settings" in _refused(tmp_path, other)


@struct.dataclass
class _Younger:
    """A state that has got one more part since."""

    known: jax.Array
    added: jax.Array | None = None


@struct.dataclass
class _Older:
    known: jax.Array


def test_a_state_from_before_an_optional_part_is_read(made: Trainer, tmp_path: Path):
    checkpoint.save(tmp_path, cast(Any, _Older(jnp.arange(3.0))), 32)
    now = made._replace(init=cast(Any, lambda key: _Younger(jnp.zeros(3))))
    found = cast(Any, checkpoint.restore(tmp_path, now))
    assert found.added is None
    np.testing.assert_array_equal(found.known, [0.0, 1.0, 2.0])
    for other, says in (
        (lambda key: _Younger(jnp.zeros(3), jnp.zeros(2)), "(added is missing)"),
        (lambda key: _Younger(jnp.zeros(4)), "(known has shape (3,) instead of (4,))"),
    ):
        assert says in _refused(tmp_path, made._replace(init=cast(Any, other)))
    checkpoint.save(tmp_path, cast(Any, _Younger(jnp.zeros(3), jnp.zeros(2))), 64)
    assert "(added is not wanted)" in _refused(tmp_path, now)


def test_a_configuration_is_read_as_it_was_written(tmp_path: Path):
    config = TrainConfig(
        clip="backflip",
        seed=7,
        samples=123,
        stop_when_learnt=False,
        env=EnvConfig(substeps=5, heading="lateral", lead=2.5),
        bounds=BoundsConfig((0.1, 0.2, 0.3), channels={"root": 0.4}, no_ground_contact=("head",)),
        motion=MotionConfig(turn_with_cycle=True),
        starts=StartsConfig(uniform=0.5),
        networks=NetworkConfig((8, 4, 2), (16,)),
        ppo=PPOConfig(lambda_=0.8),
    )
    checkpoint.write_config(tmp_path, config)
    assert checkpoint.read_config(tmp_path) == config
    assert json.loads((tmp_path / "config.json").read_text())["ppo"]["lambda_"] == 0.8


def test_sizes_over_phase_are_read_as_they_were_written(tmp_path: Path):
    knots = ((0.0, 0.2), (0.35, 0.5))
    config = TrainConfig(
        bounds=BoundsConfig(
            channels={"root": (0.4, 0.9), "com_x": 0.2, "com_y": float("inf"), "com_z": knots}
        )
    )
    checkpoint.write_config(tmp_path, config)
    assert checkpoint.read_config(tmp_path) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is damaged: "),
        ("[]", "is damaged: "),
        ("null", "is damaged: "),
        ('{"clipp": "walk"}', "is damaged: unknown entry clipp"),
        ('{"ppo": {"lr": 1}}', "is damaged: unknown entry lr"),
        ('{"ppo": 3}', "is damaged: "),
    ],
)
def test_a_damaged_configuration_is_refused(tmp_path: Path, text: str, message: str):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(UserError) as raised:
        checkpoint.read_config(tmp_path)
    assert message in str(raised.value)
    assert str(tmp_path / "config.json") in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path):
    with pytest.raises(UserError) as raised:
        checkpoint.read_config(tmp_path / "nothing")
    assert str(raised.value) == f"'{tmp_path}/nothing' is not a run: it has no config.json"


def test_a_configuration_is_replaced_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    checkpoint.write_config(tmp_path, TrainConfig(seed=1))
    whole = Path.write_text

    def half(path: Path, text: str) -> int:
        whole(path, text[: len(text) // 2])
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OSError, match="No space"):
        checkpoint.write_config(tmp_path, TrainConfig(seed=2))
    assert checkpoint.read_config(tmp_path).seed == 1
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
