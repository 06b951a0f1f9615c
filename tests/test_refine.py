# SPDX-License-Identifier: Apache-2.0
"""Finer physics from when a skill stands: when that is, and that a run goes on with it."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, runs, train, trainer
from jaxskills.errors import UserError
from jaxskills.explore import refine
from jaxskills.explore.refine import RefineConfig


def test_the_running_average_decides():
    """By hand: from 2 failures per s towards 0.05 with half of the way in each update."""
    config, state = RefineConfig(survival=4.0, memory=0.5), refine.init()
    expected = [1.025, 0.5375, 0.29375, 0.171875]  # below 1/4 from here on
    for i, average in enumerate(expected):
        state = refine.update(config, state, jnp.float32(0.5), 10.0)
        assert float(state.failures) == pytest.approx(average)
        assert bool(state.fine) == (i == 3)
    for _ in range(3):  # it does not end when episodes fail again
        state = refine.update(config, state, jnp.float32(100.0), 10.0)
    assert bool(state.fine) and float(state.failures) > 1.0


def test_infinite_is_never():
    state = refine.init()
    for _ in range(300):
        state = refine.update(RefineConfig(survival=np.inf), state, jnp.float32(0.0), 10.0)
    assert not bool(state.fine)


def test_refined_is_the_same_training_with_finer_steps(tmp_path: Path):
    made = trainer.make(tiny.train_config(tmp_path))
    finer = trainer.refined(made)
    assert finer.config.env.substeps == 2 * made.config.env.substeps
    shapes = [jax.eval_shape(m.init, jax.random.key(0)) for m in (made, finer)]
    assert jax.tree.map(lambda x: x.shape, shapes[0]) == jax.tree.map(lambda x: x.shape, shapes[1])


def test_a_run_turns_fine_and_resumes_fine(tmp_path: Path):
    """Cut in two after it has turned fine, it ends with the same bits as in one go."""
    config = tiny.train_config(tmp_path, refine=RefineConfig(survival=0.2, memory=0.5), samples=320)
    quiet = lambda metrics: None  # noqa: E731
    made, whole, _ = train.train(config, tmp_path / "whole", quiet)
    assert bool(whole.refinement.fine)
    for shown in (made, runs.open_run(tmp_path / "whole")[0]):  # what is evaluated and filmed
        assert shown.config.env.substeps == 2 * config.env.substeps
    rows = (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()
    assert json.loads(rows[-1])["fine"]
    half = dataclasses.replace(config, samples=224)
    train.train(half, tmp_path / "halves", quiet)
    assert checkpoint.read_config(tmp_path / "halves").env.substeps == config.env.substeps
    _, halves, _ = train.train(config, tmp_path / "halves", quiet, resume=True)
    same = jax.tree.map(np.array_equal, whole.learner, halves.learner)
    assert jax.tree.all(same)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (RefineConfig(survival=0.0), "refine.survival is 0.0: give a positive number, or inf"),
        (RefineConfig(factor=0), "refine.factor is 0: give 1 to 20"),
        (RefineConfig(memory=1.0), "refine.memory is 1.0: give 0 <= memory < 1"),
    ],
)
def test_out_of_range(config: RefineConfig, message: str):
    with pytest.raises(UserError) as raised:
        refine.validate(config)
    assert str(raised.value) == message
