# SPDX-License-Identifier: Apache-2.0
"""Evaluation: figures of a trace by hand, and a walker that stands or cannot."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import clip, evaluate, trainer
from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.evaluate import EvaluateConfig, Trace
from jaxskills.learn import normalize, ppo
from jaxskills.motion import MotionConfig
from jaxskills.trainer import TrainState


def _trace(fallen: list[list[int]], outside: list[list[int]]) -> Trace:
    """Returns a trace whose rows are episodes."""
    by_step = lambda rows: jnp.asarray(np.array(rows, bool).T)  # noqa: E731
    nothing = dict.fromkeys(
        ("qpos", "qvel", "phase", "errors", "sizes", "com", "torque", "over"), jnp.zeros(())
    )
    return Trace(inside=~by_step(outside), fallen=by_step(fallen), **nothing)


def test_figures_by_hand():
    """Four episodes of three steps: never, at the second step, at once (and up again), never."""
    fallen = [[0, 0, 0], [0, 1, 1], [1, 0, 0], [0, 0, 0]]
    outside = [[0, 0, 0], [1, 1, 1], [1, 1, 1], [0, 0, 1]]
    found = evaluate.summary(_trace(fallen, outside))
    assert found == pytest.approx(
        {
            "success_rate": 0.5,
            "seconds_mean": (3 + 1 + 0 + 3) / 4 / 30,
            "inside_bounds_rate": 0.25,
            "inside_seconds_mean": (3 + 0 + 0 + 2) / 4 / 30,
            "episodes": 4,
        }
    )


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> trainer.Trainer:
    """A walker that is asked to stand still."""
    folder = tmp_path_factory.mktemp("walker")
    config = tiny.train_config(folder)
    walk = clip.load(config.clip)
    still = dataclasses.replace(
        walk,
        root_pos=np.tile([0.0, 0.0, 0.5], (31, 1)),
        rotations=np.tile([1.0, 0.0, 0.0, 0.0], (31, 3, 1)),
    )
    path = clip.save(still, folder / "still.npz")
    return trainer.make(dataclasses.replace(config, clip=str(path)))


def _untrained(made: trainer.Trainer) -> TrainState:
    """Returns a state with fresh networks; evaluation needs no more of it."""
    learner = ppo.init(made.config.ppo, made.networks, jax.random.key(0))
    shown = jax.eval_shape(lambda: made.env.observe(made.env.start(jnp.float32(0.0))))
    rest = dict.fromkeys(field.name for field in dataclasses.fields(TrainState))
    parts = {"learner": learner, "normalizer": normalize.init(shown.shape[0])}
    return TrainState(**(rest | parts))  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def run(standing: trainer.Trainer) -> Callable[[], Trace]:
    """Two seconds of three episodes."""
    compiled = jit(evaluate.make(standing, EvaluateConfig(2.0, 3)))
    return lambda: compiled(_untrained(standing), jax.random.key(1))


def test_a_walker_that_stands_stands(run: Callable[[], Trace]):
    trace = run()
    assert trace.qpos.shape == (60, 3, 13)
    assert trace.qvel.shape == (60, 3, 11)
    assert trace.errors.shape == trace.sizes.shape == (60, 3, 10)
    np.testing.assert_allclose(np.diff(trace.phase, axis=0), 1.0, atol=1e-4)
    found = evaluate.summary(trace)
    assert found["success_rate"] == found["inside_bounds_rate"] == 1.0
    assert found["seconds_mean"] == pytest.approx(2.0)
    assert found["episodes"] == 3


def test_accuracy_by_hand(standing: trainer.Trainer):
    """Three steps of two episodes: one falls at its second step, the other ends at its third."""
    assert [name.endswith("_position") for name in standing.env.endings[:10]].index(True) == 7
    row = [0.3, 0.0, 0.4, 0.2, 0.1, 0.4, 0.7, 9.0, 9.0, 9.0]  # CoM, root, joints, ends
    errors = np.array([[row, row], [[np.nan] * 10, np.zeros(10)], [[7.0] * 10, [7.0] * 10]])
    trace = dataclasses.replace(
        _trace([[0, 1, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]),
        errors=errors,
        over=np.array([[0, 0], [0, 0], [0, 1]], bool),
    )
    assert evaluate.accuracy(standing.character, trace) == pytest.approx(
        {  # of three steps, the third of which is on the reference
            "com_error_mean": 2 / 3 * 0.5,
            "root_error_mean": 2 / 3 * 0.2,
            "joint_error_mean": 2 / 3 * 0.4,
        }
    )
    nothing = dataclasses.replace(trace, fallen=np.ones((3, 2), bool))
    assert set(evaluate.accuracy(standing.character, nothing).values()) == {None}


def test_an_evaluation_is_without_noise(run: Callable[[], Trace]):
    jax.tree.map(np.testing.assert_array_equal, run(), run())


def test_a_finer_engine_is_another_simulation_of_the_same_length(
    standing: trainer.Trainer, run: Callable[[], Trace]
):
    finer = jit(evaluate.make(standing, EvaluateConfig(2.0, 3, substeps=20)))
    traces = [run(), finer(_untrained(standing), jax.random.key(1))]
    np.testing.assert_array_equal(traces[0].phase, traces[1].phase)
    assert not np.array_equal(traces[0].qpos, traces[1].qpos)
    np.testing.assert_allclose(traces[0].com, traces[1].com, atol=0.02)


@pytest.mark.parametrize("end", [None, 0.3])
def test_a_motion_that_is_over_cannot_be_failed(standing: trainer.Trainer, end: float | None):
    """Leaning by 0.3 rad the walker falls over after about half a second more than 0.8 s."""
    leaning = clip.load(standing.config.clip)
    tilt = np.tile([np.cos(0.15), 0.0, np.sin(0.15), 0.0], (31, 1))
    path = clip.save(
        dataclasses.replace(leaning, root_rot=tilt), Path(standing.config.clip).parent / "lean.npz"
    )
    changed = dataclasses.replace(
        standing.config, clip=str(path), motion=MotionConfig(end=end, close_loop=0.0)
    )
    made = trainer.make(changed)
    config = EvaluateConfig(3.0, 2, start=0.0)
    trace = jit(evaluate.make(made, config))(_untrained(made), jax.random.key(1))
    found = evaluate.summary(trace)
    over = np.asarray(trace.over)
    if end is None:
        assert found["success_rate"] == 0.0 and found["seconds_mean"] > 0.8 and not over.any()
        return
    assert found["success_rate"] == 1.0
    np.testing.assert_array_equal(over.argmax(0), 9 + 15)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EvaluateConfig(seconds=0.0), "seconds is 0.0: give 1/30 to 3600"),
        (EvaluateConfig(seconds=4000.0), "seconds is 4000.0: give 1/30 to 3600"),
        (EvaluateConfig(episodes=0), "episodes is 0: give 1 to 65536"),
        (EvaluateConfig(substeps=101), "substeps is 101: give 1 to 100"),
        (EvaluateConfig(start=1.5), "start is 1.5: give 0 to 1, or none"),
        (EvaluateConfig(substeps=0), "substeps is 0: give 1 to 100"),
    ],
)
def test_what_is_out_of_range_is_refused(standing, config: EvaluateConfig, message: str):
    with pytest.raises(UserError) as raised:
        evaluate.make(standing, config)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)
