# SPDX-License-Identifier: Apache-2.0
"""Measures of style: of episodes that are the reference itself, of what falls, of other clips."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny
from scipy.spatial import ConvexHull

from jaxskills import character, clip, evaluate, style_measures, trainer
from jaxskills.compilation import jit
from jaxskills.env.core import EnvConfig
from jaxskills.env.style import StyleConfig
from jaxskills.errors import UserError
from jaxskills.evaluate import Trace
from jaxskills.learn import autoencoder, windows
from jaxskills.learn.autoencoder import AutoencoderConfig
from jaxskills.motion import sample
from jaxskills.trainer import Trainer

measures = style_measures.style_measures
HEURISTIC = {"energy_mean", "volume_mean", "reference_energy_mean", "reference_volume_mean"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("walker")


@pytest.fixture(scope="module")
def plain(folder: Path) -> Trainer:
    return trainer.make(tiny.train_config(folder))


@pytest.fixture(scope="module")
def styled(folder: Path, plain: Trainer) -> Trainer:
    """A run that wants the walk's own style, by a small autoencoder."""
    config = AutoencoderConfig(channels=8, width=5, window=12)
    data = windows.cut(plain.character, [plain.motion], 12, (1.0,))[0]
    model = autoencoder.init(
        config, plain.character.body_names, jnp.asarray(data), jax.random.key(0)
    )
    path = autoencoder.save(model, folder / "small.npz")
    style = StyleConfig(style="gram", style_clip=plain.config.clip, autoencoder=str(path))
    return trainer.make(
        dataclasses.replace(plain.config, env=EnvConfig(reward="style", style=style))
    )


@pytest.fixture(scope="module")
def trace(plain: Trainer) -> Trace:
    """Two episodes of three cycles that are the reference from two phases on, without a fall."""
    phase = np.arange(1, 91)[:, None] + np.array([0.0, 7.3])
    at = jax.vmap(jax.vmap(lambda p: sample(plain.character.layout, plain.motion, p)))
    qpos, qvel = jit(at)(jnp.asarray(phase, jnp.float32))
    names = ("phase", "errors", "sizes", "inside", "com", "torque", "over")
    nothing = dict.fromkeys(names, jnp.zeros(()))
    return Trace(qpos=qpos, qvel=qvel, fallen=jnp.zeros(phase.shape, bool), **nothing)


@pytest.fixture(scope="module")
def found(styled: Trainer, trace: Trace) -> dict[str, Any]:
    return measures(styled, trace)


def test_the_reference_is_as_the_reference(found: dict[str, Any]):
    assert set(found) == HEURISTIC | {"gram_distance_mean", "reference_gram_distance_mean"}
    assert found["reference_energy_mean"] > 0.1
    assert found["energy_mean"] == pytest.approx(found["reference_energy_mean"], rel=0.02)
    assert found["reference_gram_distance_mean"] == pytest.approx(0.0, abs=1e-5)
    assert found["gram_distance_mean"] == pytest.approx(0.0, abs=0.01)


def test_a_plain_run_has_no_style_to_be_measured_by(plain: Trainer, trace: Trace, found):
    assert measures(plain, trace) == {name: found[name] for name in HEURISTIC}


def test_what_comes_after_a_fall_does_not_count(styled: Trainer, trace: Trace, found):
    fallen = np.zeros((90, 2), bool)
    fallen[60, 0] = True  # and up again
    moved = trace.replace(
        qvel=trace.qvel.at[60:, 0].set(1e3),
        qpos=trace.qpos.at[60:, 0].set(jnp.nan),
        fallen=jnp.asarray(fallen),
    )
    kept = measures(styled, moved)
    assert kept["energy_mean"] == pytest.approx(found["energy_mean"], rel=0.02)
    assert kept["gram_distance_mean"] == pytest.approx(found["gram_distance_mean"], abs=1e-3)


@pytest.mark.parametrize(("lasts", "count"), [(90, 4), (64, 4), (63, 3), (34, 3), (33, 2), (0, 2)])
def test_stretches_end_before_the_fall(lasts: int, count: int):
    """Of 90 steps, rows of 5 begin after 4; stretches are 30 long: two an episode."""
    fallen = np.zeros((90, 2), bool)
    fallen[lasts:, 1] = True
    assert style_measures._before_fall(fallen, 5, 30).shape == (2, 2)
    assert style_measures._before_fall(fallen, 5, 30).sum() == count


def test_an_episode_shorter_than_a_stretch_has_none(styled: Trainer, trace: Trace):
    short = jax.tree.map(lambda x: x[:33] if x.ndim else x, trace)
    style: Any = SimpleNamespace(width=5, steps=30)
    assert len(style_measures.gram_distances(styled, short, style)) == 0


def test_nothing_to_measure(styled: Trainer, trace: Trace, found):
    none = measures(styled, trace.replace(fallen=jnp.ones((90, 2), bool)))
    assert none["energy_mean"] is none["volume_mean"] is none["gram_distance_mean"] is None
    assert none["reference_energy_mean"] == pytest.approx(found["reference_energy_mean"])


def test_energy_and_volume_of_many_states(plain: Trainer, trace: Trace):
    """Each state for itself, however many: more than are measured at once."""
    qpos, qvel = (np.asarray(x)[:, 0] for x in (trace.qpos, trace.qvel))
    few = style_measures.energy_and_volume(plain, qpos[:3], qvel[:3])
    many = style_measures.energy_and_volume(plain, np.tile(qpos, (4, 1)), np.tile(qvel, (4, 1)))
    assert many.shape == (360, 2)
    np.testing.assert_allclose(many[:3], few, rtol=1e-5)
    np.testing.assert_allclose(many[90:180], many[:90], rtol=1e-5)
    # Twice as fast is four times the energy, in the same room.
    mixed = style_measures.energy_and_volume(plain, qpos[[0, 0]], np.stack((qvel[0], 2 * qvel[0])))
    np.testing.assert_allclose(mixed[1], mixed[0] * [4.0, 1.0], rtol=1e-4)


def test_the_volume_is_that_of_scipy():
    """Of the body origins; the walker's lie in a plane, the humanoid's do not."""
    who = character.load("humanoid34")
    random, data = np.random.default_rng(0), mujoco.MjData(who.model)
    poses, expected = [], []
    for _ in range(5):
        qpos = who.model.qpos0.copy()
        mujoco.mj_integratePos(who.model, qpos, random.normal(0, 0.4, 34), 1.0)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(who.model, data)
        poses.append(qpos)
        expected.append(ConvexHull(data.xpos[1:]).volume)
    made: Any = SimpleNamespace(character=who)
    found = style_measures.energy_and_volume(made, np.float32(poses), np.zeros((5, 34), np.float32))
    np.testing.assert_allclose(found, np.stack((np.zeros(5), expected), 1), atol=1e-3)


def test_against_another_clip(plain: Trainer, styled: Trainer, trace: Trace, folder: Path):
    walk = clip.load(plain.config.clip)
    still = dataclasses.replace(
        walk,
        root_pos=np.tile([0.0, 0.0, 0.5], (31, 1)),
        rotations=np.tile([1.0, 0.0, 0.0, 0.0], (31, 3, 1)),
    )
    path = clip.save(still, folder / "still.npz")
    apart: Any = measures(styled, trace, str(path))
    assert apart["gram_distance_mean"] > 0.05
    own = apart["reference_gram_distance_mean"]
    assert apart["gram_distance_mean"] == pytest.approx(own, rel=0.05)
    with pytest.raises(UserError, match="knows the bodies root, chest"):
        measures(plain, trace, str(path))  # the shipped one is for another character


def test_a_styled_run_can_be_evaluated(styled: Trainer):
    """The environment of the evaluation ends at falls only, and still holds a window."""
    compiled = evaluate.make(styled, evaluate.EvaluateConfig(0.2, 2))
    state = jax.eval_shape(styled.init, jax.random.key(0))
    trace = jax.eval_shape(compiled, state, jax.random.key(1))
    assert trace.qvel.shape == (6, 2, 11)
    assert state.current.state.window.hidden.shape == (8, 30, 8)
