# SPDX-License-Identifier: Apache-2.0
"""A family performs task parameters, is measured, and is drawn with its own bodies."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_family
from PIL import Image

from jaxskills import evaluate_family, families, perform, playback_family, runs
from jaxskills.env import measure
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.evaluate_family import FamilyEvaluateConfig
from jaxskills.explore import family as family_lib
from jaxskills.perform import Performances
from jaxskills.render import opengl
from jaxskills.trainer import Trainer, TrainState

A = np.array([[0.2, 0.2], [0.2, 1.0], [0.8, 0.2]], np.float32)  # height, gravity


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Trainer, TrainState]:
    made = families.make(tiny_family.config(tmp_path_factory.mktemp("walks")))
    return made, tiny_family.trained(made)


@pytest.fixture(scope="module")
def done(trained: tuple[Trainer, TrainState]) -> Performances:
    return perform.perform(*trained, A)


def test_a_performance_is_the_whole_motion(trained: tuple[Trainer, TrainState], done):
    steps, length = np.asarray(done.steps), float(trained[0].motion.length)
    assert np.asarray(done.through).all()
    ends = np.asarray(done.trace.phase)[steps - 1, np.arange(3)]
    before = np.asarray(done.trace.phase)[steps - 2, np.arange(3)]
    assert (ends > length + 15.0).all() and (before <= length + 15.0).all()


def test_each_follows_its_own_motion(trained: tuple[Trainer, TrainState], done: Performances):
    """Two elites, 0.02 lower and 0.04 higher, are equally near in gravity."""
    height, own = np.asarray(done.reference)[..., 2], trained[0].motion.qpos[0, 2]
    assert height[5, 0] - own == pytest.approx(-0.02, abs=2e-3)
    assert height[5, 2] - own == pytest.approx(0.04, abs=2e-3)
    np.testing.assert_allclose(height[:3, 0], height[:3, 1], atol=2e-3)


def test_each_has_its_own_gravity(trained: tuple[Trainer, TrainState], done: Performances):
    models = [who.model for who in perform.characters(trained[0], A)]
    pull = [model.opt.gravity[2] / -9.81 for model in models]
    np.testing.assert_allclose(pull, [0.8, 2.0, 0.8], rtol=1e-4)
    com = np.asarray(done.trace.com)[:, :, 2]
    assert not np.allclose(com[:20, 0], com[:20, 1], atol=1e-4)
    np.testing.assert_allclose(np.asarray(done.met)[:, 1], A[:, 1])


def test_what_is_measured_is_what_happened(trained: tuple[Trainer, TrainState], done):
    """The height of the centre of mass half way, in multiples of the reference's."""
    length = float(trained[0].motion.length)
    own = float(families.parts(trained[0].config, trained[0].task).task.reference[0])
    for i in range(3):
        phase, com = np.asarray(done.trace.phase)[:, i], np.asarray(done.trace.com)[:, i, 2]
        expected = np.interp(length / 2, phase, com) / own - 0.5
        assert float(done.met[i, 0]) == pytest.approx(expected, abs=1e-3)


def test_a_motion_without_parameterisation_is_the_reference(trained):
    made, state = trained
    config = made.config.family
    asked = family_lib.best(config, state.family, jnp.asarray(A))
    assert min(np.abs(asked.x).max(), np.abs(asked.fed).max()) > 0.01
    for changed in (
        (dataclasses.replace(config, vary=False), state.family),
        (config, dataclasses.replace(state.family, base=_unlearnt(state))),
    ):
        plain = family_lib.best(*changed, jnp.asarray(A))
        assert not np.any(plain.x) and not np.any(plain.fed)
        np.testing.assert_array_equal(plain.a, A)


def _unlearnt(state: TrainState):
    return dataclasses.replace(state.family.base, learnt=jnp.bool_(False))


def test_figures(trained: tuple[Trainer, TrainState], done: Performances):
    """By hand: the second one falls, the third one is off by 0.3 of 1.3, the first one by none."""
    met = jnp.asarray(A).at[2, 0].set(0.8 - 0.3)
    good = jnp.array([True, False, True])
    known = dataclasses.replace(
        done, met=met, through=good, steps=jnp.array([30, 3, 36]), fitness=jnp.array([0.5, 9, 0.7])
    )
    found = evaluate_family.summary(*trained, known)
    assert found["success_rate"] == pytest.approx(2 / 3)
    assert found["seconds_mean"] == pytest.approx(69 / 3 / 30)
    assert found["fitness_mean"] == pytest.approx(0.6)
    assert "constraint_mean" not in found
    error = found["errors"]["height"]
    assert set(found["errors"]) == {"height"} and error["relative"]
    assert error["mean"] == pytest.approx(0.3 / 1.3 / 2, abs=1e-5)
    assert error["share"] == error["mean"]
    assert error["p95"] == pytest.approx(0.95 * 0.3 / 1.3, abs=1e-5)
    assert (found["training_episodes"], found["episodes"]) == (1234, 3)
    second = found["performances"][1]
    assert second["asked"] == pytest.approx({"height": 0.7, "gravity": 2.0})
    assert (second["measured"], second["success"]) == (None, False)
    assert found["performances"][2]["measured"] == pytest.approx({"height": 1.0})
    lines = evaluate_family.lines(found)
    assert "error of height              11.5% in the mean, 95 % below 21.9%" in lines
    nobody = dataclasses.replace(known, through=jnp.zeros(3, bool))
    none = evaluate_family.summary(*trained, nobody)
    assert none["errors"] == {} and "fitness_mean" not in none


def test_an_absolute_error_is_also_a_share_of_the_range():
    """By hand: off by 0.2 and 0.1 of a range 3 rad wide."""
    turned = measure.change(measure.turning("root"), 0.0, 1.0)
    spec = TaskSpec((Parameter("angle", (-1.5, 1.5), turned, relative=False),))
    asked, met = np.array([[0.5], [0.6]]), np.array([[0.7], [0.5]])
    error = evaluate_family.errors(spec, asked, met)["angle"]
    assert error["mean"] == pytest.approx(0.45) and error["share"] == pytest.approx(0.15)
    found = {"errors": {"angle": error}, "explored_ranges": {}}
    expected = (
        "error of angle               0.45 in the mean (15.0% of the range), 95 % below 0.585"
    )
    assert evaluate_family.lines(found) == [expected]


def test_what_is_explored(trained: tuple[Trainer, TrainState]):
    """Two elites at 0.2 and 0.8 of the height, each a disc of 0.047 of the range around."""
    ratio, ranges = evaluate_family.explored(*trained)
    reach = 0.1 * np.sqrt(np.log(1 / 0.8))
    assert ratio == pytest.approx(2 * np.pi * reach**2, abs=0.006)
    expected = [0.5 + 0.2 - reach, 0.5 + 0.8 + reach]
    assert ranges["height"] == pytest.approx(expected, abs=0.02)
    assert ranges["gravity"] == pytest.approx([1.25 - 1.5 * reach, 1.25 + 1.5 * reach], abs=0.02)


def test_new_parameters_are_spread_evenly(trained: tuple[Trainer, TrainState]):
    made = trained[0]
    a = evaluate_family.parameters(made, FamilyEvaluateConfig(64))
    assert a.shape == (64, 2) and 0.0 <= a.min() and a.max() < 1.0
    counts = np.histogram2d(*a.T, bins=4, range=[[0, 1], [0, 1]])[0]
    assert counts.min() >= 2 and counts.max() <= 6
    other = evaluate_family.parameters(made, FamilyEvaluateConfig(64, seed=2))
    assert not np.isclose(a[:, None], other[None], atol=1e-6).all(-1).any()
    with pytest.raises(UserError, match="episodes is 0: give 1 to 65536"):
        evaluate_family.parameters(made, FamilyEvaluateConfig(0))


def test_a_skill_takes_no_parameters(trained: tuple[Trainer, TrainState]):
    with pytest.raises(UserError, match="this run is of one skill"):
        perform.perform(trained[0]._replace(task=None), trained[1], A)


def test_pictures_of_what_is_explored(trained: tuple[Trainer, TrainState], done: Performances):
    seen = playback_family.explored(*trained)
    assert seen.names == ("height", "gravity") and len(seen.elites) == 2
    np.testing.assert_allclose(seen.elites, [[0.7, 1.25], [1.3, 1.25]], atol=1e-6)
    values = seen.maps[0, 1]  # row: gravity, column: height
    row, column = np.unravel_index(values.argmax(), values.shape)
    assert abs((row + 0.5) / len(values) - 0.5) < 0.03
    assert min(abs((column + 0.5) / len(values) - x) for x in (0.2, 0.8)) < 0.03
    asked = playback_family.asked(trained[0], done)
    assert asked.names == ("height",)
    np.testing.assert_allclose(asked.asked[:, 0], 0.5 + A[:, 0])


def test_maps_of_more_and_fewer_parameters(trained: tuple[Trainer, TrainState]):
    made, state = trained
    elites = state.family.elites
    for count, places in ((1, [(0,)]), (3, [(0, 1), (0, 2), (1, 2)])):
        a = jnp.tile(elites.a[:, :1], (1, count))
        family = dataclasses.replace(state.family, elites=dataclasses.replace(elites, a=a))
        maps = playback_family._maps(made, dataclasses.replace(state, family=family), count)
        assert list(maps) == places
        assert all(np.isfinite(values).all() and values.max() > 0 for values in maps.values())


def test_films(trained: tuple[Trainer, TrainState], tmp_path: Path):
    try:
        opengl.backend()
    except UserError as missing:
        pytest.skip(str(missing))
    wanted = playback_family.wanted(*trained, ["height=0.7,1,1.3"])
    cells = playback_family.cells(*trained, wanted, 0.5)
    assert [len(row) for row in cells] == [3]
    assert all(0 < len(cell.qpos) <= 15 for cell in cells[0])
    tall = []
    for shown in (cells, [cells[0][:1]]):
        path = playback_family.film(shown, tmp_path / "strip.png")
        with Image.open(path) as drawn:
            assert np.asarray(drawn.convert("L")).std() > 5
            tall.append(drawn.height / drawn.width)
    assert tall[0] == pytest.approx(1.5 * tall[1], rel=0.2)  # the one has its reference above


def test_the_grid_of_a_finished_training(trained: tuple[Trainer, TrainState]):
    assert playback_family.wanted(*trained, None).a.shape == (3, 3, 2)


def test_a_run_is_opened_as_a_family(trained: tuple[Trainer, TrainState], tmp_path: Path):
    run = tiny_family.write_run(tmp_path / "run", *trained)
    made, state = runs.open_run(run)
    assert made.task is not None and [p.name for p in made.task.free] == ["height", "gravity"]
    jax.tree.map(np.testing.assert_array_equal, state.family.elites, trained[1].family.elites)
    assert made.config.bounds == BoundsConfig()
