# SPDX-License-Identifier: Apache-2.0
"""A controller played back: what pictures and films are made of."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny
from PIL import Image

from jaxskills import playback, plot, trainer
from jaxskills.compilation import jit
from jaxskills.env.bounds import BoundsConfig
from jaxskills.errors import UserError
from jaxskills.evaluate import EvaluateConfig, Trace
from jaxskills.explore import evolution
from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.render import opengl
from jaxskills.trainer import Trainer, TrainState


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trainer, TrainState]:
    made = trainer.make(tiny.train_config(tmp_path_factory.mktemp("walker")))
    return made, jit(made.init)(jax.random.key(0))


@pytest.fixture(scope="module")
def trace(untrained: tuple[Trainer, TrainState]) -> Trace:
    return playback.play(*untrained, EvaluateConfig(seconds=1.0, episodes=3))


def test_states_after_a_fall_are_left_out(untrained: tuple[Trainer, TrainState], trace: Trace):
    fallen = np.zeros((30, 3), bool)
    fallen[10:, 0], fallen[0:, 1] = True, True
    shown = playback.played(untrained[0], trace.replace(fallen=fallen))
    assert len(shown.phase) == len(shown.height) == 10 + 0 + 30
    assert {len(values) for values in shown.margins.values()} == {40}
    assert ((shown.phase >= 0) & (shown.phase <= 1)).all()


def test_margins(untrained: tuple[Trainer, TrainState], trace: Trace):
    errors, sizes = np.array(trace.errors), np.asarray(trace.sizes)
    errors[:, :, 2] = 0.25 * sizes[:, :, 2]
    names = untrained[0].env.endings
    shown = playback.played(
        untrained[0], trace.replace(errors=errors, fallen=np.zeros((30, 3), bool))
    )
    np.testing.assert_allclose(shown.margins[names[2]], 0.75, rtol=1e-6)
    assert set(shown.margins) == set(names[: errors.shape[2]])


def test_first_departures_are_counted_by_bound_and_phase(
    untrained: tuple[Trainer, TrainState], trace: Trace
):
    made = untrained[0]
    errors, inside = np.zeros_like(trace.errors), np.ones((30, 3), bool)
    inside[4:, 0] = False  # a bound
    errors[4, 0, 1] = 1.5 * np.asarray(trace.sizes)[4, 0, 1]
    errors[4, 0, 0] = 1.1 * np.asarray(trace.sizes)[4, 0, 0]
    inside[7:, 2] = False  # no bound is passed: a body that may not touch the ground
    phase = np.full((30, 3), 0.32 * made.env.length, np.float32)
    shown = playback.played(made, trace.replace(errors=errors, inside=inside, phase=phase))
    counted = {name: counts for name, counts in shown.endings.items() if counts.any()}
    assert set(counted) == {made.env.endings[1], "ground contact"}
    for counts in counted.values():
        assert counts[6] == counts.sum() == 1  # 0.32 lies in the seventh of 20 parts


def test_height_of_the_reference(untrained: tuple[Trainer, TrainState], trace: Trace):
    """The walker's pelvis stays at 0.5 m; its centre of mass hardly moves."""
    shown = playback.played(untrained[0], trace)
    assert shown.reference_height.shape == shown.reference_phase.shape
    # masses and heights: pelvis 3 kg, torso 2 kg, legs 1 kg each, feet 0.5 kg each
    standing = (3 * 0.5 + 2 * (0.58 + 0.125) + 2 * (0.5 - 0.24) + 1 * (0.5 - 0.48)) / 8
    np.testing.assert_allclose(shown.reference_height, standing, atol=0.02)


def test_evolved_starts(untrained: tuple[Trainer, TrainState]):
    """A tenth of a metre higher than the reference, everywhere: so much are all bodies apart."""
    made, state = untrained
    assert playback.evolved(made, state) is None
    elites = evolution.init(
        EvolutionConfig(elites=3), made.character.layout, made.motion, segments=5
    )
    higher = elites.qpos + 0.1 * (np.arange(elites.qpos.shape[-1]) == 2)
    shown = playback.evolved(made, state.replace(elites=elites.replace(qpos=higher)))
    assert shown is not None
    np.testing.assert_allclose(shown.phase, np.arange(15) / 15, atol=1e-6)
    assert shown.places.shape == shown.at_phase.shape == (15, 12)
    apart = (shown.places - shown.at_phase).reshape(15, 4, 3)
    np.testing.assert_allclose(apart, np.broadcast_to([0.0, 0.0, 0.1], (15, 4, 3)), atol=1e-5)
    # The walk goes half a metre ahead, but is seen from under the root.
    assert np.abs(shown.reference[:, 0]).max() < 0.01
    assert shown.reference.shape == (201, 12) and shown.reference_phase[-1] == 1.0


def test_the_bound_on_the_height_over_phase(untrained: tuple[Trainer, TrainState], trace: Trace):
    made = untrained[0]
    for size, expected in (
        (
            ((0.0, 0.2), (0.35, 0.5), (1.0, 0.2)),
            np.interp(np.linspace(0, 1, 101), [0, 0.35, 1], [0.2, 0.5, 0.2]),
        ),
        (float("inf"), np.full(101, np.nan)),
    ):
        changed = dataclasses.replace(made.config, bounds=BoundsConfig(channels={"com_z": size}))
        shown = playback.played(made._replace(config=changed), trace)
        np.testing.assert_allclose(shown.bound, expected)


def test_picture(untrained: tuple[Trainer, TrainState], trace: Trace, tmp_path: Path):
    rows = [{"samples": 32 * i, "wall_s": 1.0 * i, "survival_s": 0.1 * i} for i in (1, 2)]
    path = plot.figure(tmp_path / "walk.png", "walk", rows, playback.played(untrained[0], trace))
    with Image.open(path) as page:
        assert page.width > 1000


def test_film(untrained: tuple[Trainer, TrainState], tmp_path: Path):
    try:
        opengl.backend()
    except UserError as missing:
        pytest.skip(str(missing))
    strip = playback.film(*untrained, tmp_path / "strip.png", seconds=1.0)
    with Image.open(strip) as drawn:
        assert np.asarray(drawn.convert("L")).std() > 5  # something is in it
