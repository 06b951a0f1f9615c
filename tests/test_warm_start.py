# SPDX-License-Identifier: Apache-2.0
"""A training begins with the networks of another run."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, families, train, warm_start
from jaxskills.errors import UserError
from jaxskills.learn.networks import NetworkConfig
from jaxskills.trainer import TrainConfig

pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> TrainConfig:
    return tiny.train_config(tmp_path_factory.mktemp("walker"), samples=64, stop_when_learnt=False)


@pytest.fixture(scope="module")
def learnt(config: TrainConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("learnt")
    train.train(config, run, lambda metrics: None)
    return run


def test_networks_and_statistics_are_taken_over_and_the_rest_begins_anew(
    config: TrainConfig, learnt: Path
):
    made = families.make(dataclasses.replace(config, seed=5))
    first, last = made.init(jax.random.key(5)), checkpoint.restore(learnt, made)
    state = warm_start.begin(first, warm_start.read(made, learnt))
    theirs = last.learner.policy, last.learner.value, last.normalizer
    for mine, other in zip(
        jax.tree.leaves((state.learner.policy, state.learner.value, state.normalizer)),
        jax.tree.leaves(theirs),
        strict=True,
    ):
        np.testing.assert_array_equal(mine, other)
    assert (int(state.samples), int(state.updates)) == (0, 0)
    for opt in (state.learner.policy_opt, state.learner.value_opt):
        assert all((np.asarray(x) == 0).all() for x in jax.tree.leaves(opt))
    assert state.starts is first.starts and state.current is first.current


def test_a_run_can_begin_with_another_one(config: TrainConfig, learnt: Path, tmp_path: Path):
    """With a step size of next to nothing its networks are still those of the other one."""
    tame = dataclasses.replace(config.ppo, policy_lr=1e-12, value_lr=1e-12, target_kl=0.0)
    further = dataclasses.replace(config, init_from=str(learnt), ppo=tame)
    made, state, _ = train.train(further, tmp_path / "run", lambda metrics: None)
    before = checkpoint.restore(learnt, made).learner
    for mine, other in zip(
        jax.tree.leaves((state.learner.policy, state.learner.value)),
        jax.tree.leaves((before.policy, before.value)),
        strict=True,
    ):
        np.testing.assert_allclose(mine, other, atol=1e-8)
    assert checkpoint.read_config(tmp_path / "run").init_from == str(learnt)


def test_networks_of_other_sizes_are_refused(config: TrainConfig, learnt: Path, tmp_path: Path):
    wide = dataclasses.replace(config, networks=NetworkConfig((24,), (16,)), init_from=str(learnt))
    with pytest.raises(UserError, match="init_from: in run .* give a run with the same") as raised:
        train.train(wide, tmp_path / "run", lambda metrics: None)
    assert "\n" not in str(raised.value)


def test_a_folder_that_is_no_run_is_refused(config: TrainConfig, tmp_path: Path):
    nowhere = dataclasses.replace(config, init_from=str(tmp_path / "nowhere"))
    with pytest.raises(UserError, match="nowhere' is not a run"):
        train.train(nowhere, tmp_path / "run", lambda metrics: None)
    assert not (tmp_path / "run").exists()
