# SPDX-License-Identifier: Apache-2.0
"""Adaptive bounds: the scale by literal values, in the environment, in training and resumed."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, evaluate, train, trainer
from jaxskills.compilation import jit
from jaxskills.env.core import EnvConfig
from jaxskills.errors import UserError
from jaxskills.explore import adaptive
from jaxskills.explore.adaptive import Adaptive, AdaptiveBoundsConfig
from jaxskills.learn import rollout
from jaxskills.motion import CONTROL_DT
from jaxskills.trainer import TrainConfig

SLOW = AdaptiveBoundsConfig(enabled=True, target=2.0, rate=0.1, memory=0.0, low=0.4, high=3.0)
LEARN = AdaptiveBoundsConfig(enabled=True, target=0.3, start=1.5, rate=0.05, memory=0.5)


pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> TrainConfig:
    folder = tmp_path_factory.mktemp("walker")
    return tiny.train_config(folder, adaptive_bounds=LEARN, stop_when_learnt=False)


def _at(scale: float, failures: float = 0.5) -> Adaptive:
    return Adaptive(jnp.float32(scale), jnp.float32(failures))


@pytest.mark.parametrize(
    ("failures", "factor"),
    [  # in 20 s, where the target of 2 s allows ten
        (0, math.exp(-0.1)),
        (5, math.exp(-0.05)),
        (10, 1.0),
        (15, math.exp(0.05)),
        (20, math.exp(0.1)),
        (600, math.exp(0.1)),
    ],
)
def test_the_scale_follows_how_long_episodes_last(failures: int, factor: float):
    after = adaptive.update(SLOW, _at(1.0), jnp.float32(failures), 20.0)
    assert float(after.scale) == pytest.approx(factor, rel=1e-6)
    assert float(after.failures) == pytest.approx(failures / 20.0)


def test_the_scale_stays_within_its_limits():
    for start, failures, end in ((0.41, 0, 0.4), (2.9, 100, 3.0)):
        after = adaptive.update(SLOW, _at(start), jnp.float32(failures), 20.0)
        assert float(after.scale) == pytest.approx(end)


def test_one_update_counts_little():
    """Nine tenths of what was known stay: 0.9 x 0.5 + 0.1 x 0 failures per s, 0.9 of the target."""
    config = dataclasses.replace(SLOW, memory=0.9)
    after = adaptive.update(config, _at(1.0), jnp.float32(0.0), 20.0)
    assert float(after.failures) == pytest.approx(0.45)
    assert float(after.scale) == pytest.approx(math.exp(-0.01), rel=1e-6)


def test_it_begins_at_its_start_and_moves_on_evidence_alone():
    begin = adaptive.init(dataclasses.replace(SLOW, start=1.5, memory=0.9))
    assert (float(begin.scale), float(begin.failures)) == (1.5, 0.5)
    after = adaptive.update(SLOW, begin, jnp.float32(10.0), 20.0)
    assert float(after.scale) == pytest.approx(1.5)


def test_a_scale_multiplies_every_size_of_an_environment(tmp_path: Path):
    who = tiny.load_character(tmp_path)
    env = tiny.make_env(who, tiny.make_motion(who, tiny.walking(), True))
    qpos = jnp.asarray(tiny.walking()[0], jnp.float32).at[2].add(0.3)  # the bound there is 0.2 m
    state, step = env.place(jnp.float32(0.0), qpos, jnp.zeros(who.layout.nv)), jit(env.step)
    still = jnp.zeros(env.action_size)
    assert state.scale is None
    plain = step(state, still)[1]
    for scale, inside in ((0.5, False), (1.0, False), (2.0, True)):
        after, outcome = step(state.replace(scale=jnp.float32(scale)), still)
        assert bool(outcome.report.inside) == inside != bool(outcome.terminated)
        np.testing.assert_allclose(outcome.report.sizes, scale * plain.report.sizes, rtol=1e-6)
        np.testing.assert_array_equal(outcome.report.errors, plain.report.errors)
        assert float(after.scale) == scale
        if not inside:
            assert env.endings[int(outcome.report.ended_by)] == "com_z"


def test_training_adapts_and_goes_on_bit_for_bit(config: TrainConfig, tmp_path: Path):
    made = trainer.make(config)
    state, update = jit(made.init)(jax.random.key(0)), jit(made.update)
    scale, average = 1.5, 1 / 0.3
    for count in range(1, 9):
        state, metrics = update(state)
        assert float(metrics["bound_scale"]) == pytest.approx(scale, rel=1e-5)
        np.testing.assert_array_equal(state.current.state.scale, [metrics["bound_scale"]] * 8)
        limit = made.env.endings.index("time limit")
        failures = float(np.delete(metrics["endings"], limit, axis=0).sum())
        average = 0.5 * average + 0.5 * failures / (8 * 4 * CONTROL_DT)
        scale = np.clip(scale * math.exp(0.05 * (min(0.3 * average, 2.0) - 1.0)), 0.5, 2.0)
        if count == 4:
            checkpoint.save(tmp_path, state, 128)
    assert state.adaptive is not None and scale != 1.5
    assert float(state.adaptive.scale) == pytest.approx(scale, rel=1e-5)
    again = checkpoint.restore(tmp_path, made)
    for _ in range(4):
        again, _ = update(again)
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(state), strict=True):
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        x, y = (jax.random.key_data(z) if is_key else z for z in (x, y))
        np.testing.assert_array_equal(x, y)


def test_bounds_are_tested_at_their_own_sizes(config: TrainConfig):
    """An evaluation of an adapted run begins without a scale."""
    made = trainer.make(config)
    state = jax.eval_shape(made.init, jax.random.key(0))
    trace = evaluate.make(made, evaluate.EvaluateConfig(seconds=0.1, episodes=2))
    assert jax.eval_shape(trace, state, jax.random.key(1)).sizes.shape == (3, 2, 10)
    begin = jax.eval_shape(lambda: rollout.begin(made.env, jnp.zeros(2)))
    assert begin.state.scale is None


def test_a_run_says_its_scale_and_keeps_its_settings(config: TrainConfig, tmp_path: Path):
    settings = dataclasses.replace(config, samples=6 * 32)
    _, state, _ = train.train(settings, tmp_path, lambda metrics: None)
    lines = [json.loads(row) for row in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert lines[0]["bound_scale"] == 1.5
    assert state.adaptive is not None
    assert all(0.5 <= line["bound_scale"] <= 2.0 for line in lines)
    assert checkpoint.read_config(tmp_path) == settings


def test_off_leaves_no_trace(tmp_path: Path):
    made = trainer.make(tiny.train_config(tmp_path))
    state = jax.eval_shape(made.init, jax.random.key(0))
    after, metrics = jax.eval_shape(made.update, state)
    assert state.adaptive is None and after.adaptive is None
    assert state.current.state.scale is None and after.current.state.scale is None
    assert "bound_scale" not in metrics


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": 0.0}, "adaptive_bounds.target is 0.0: give 0 to 3600 s"),
        ({"low": 0.0}, "adaptive_bounds.low, start, high are 0.0, 1.0, 2.0: give 0 < low <= start"),
        ({"start": 2.5}, "adaptive_bounds.low, start, high are 0.5, 2.5, 2.0: give 0 < low <="),
        ({"high": math.inf}, "adaptive_bounds.low, start, high are 0.5, 1.0, inf: give 0 < low"),
        ({"rate": -0.1}, "adaptive_bounds.rate is -0.1: give 0 to 1"),
        ({"memory": 1.0}, "adaptive_bounds.memory is 1.0: give 0 <= memory < 1"),
        ({"memory": math.nan}, "adaptive_bounds.memory is nan: give 0 <= memory < 1"),
    ],
)
def test_what_is_out_of_range_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError) as raised:
        trainer.validate(TrainConfig(adaptive_bounds=AdaptiveBoundsConfig(**changes)))
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)


def test_episodes_that_end_on_a_fall_have_no_bounds_to_adapt():
    config = TrainConfig(adaptive_bounds=SLOW, env=EnvConfig(stop="fall"))
    with pytest.raises(UserError, match="^env.stop is fall: adaptive_bounds need bounds"):
        trainer.validate(config)
