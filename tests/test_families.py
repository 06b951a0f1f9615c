# SPDX-License-Identifier: Apache-2.0
"""Training of a family: same bits, saved and continued, traced once, worlds of its conditions."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import checkpoint, families, motion
from jaxskills.compilation import jit
from jaxskills.env import conditions, measure
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.explore.curriculum import CurriculumConfig
from jaxskills.explore.family import FamilyConfig
from jaxskills.explore.marginal import MarginalConfig
from jaxskills.explore.parameterization import ParameterizationConfig
from jaxskills.explore.sampling import SamplingConfig
from jaxskills.trainer import TrainConfig, Trainer, TrainState

FORWARD = measure.com_along((1.0, 0.0, 0.0))
SPEC = TaskSpec(
    (
        Parameter("way", (0.5, 1.5), measure=measure.change(FORWARD, 0.1, 0.9)),
        Parameter("legs", (0.8, 1.2), condition=conditions.length(("left_leg", "right_leg"))),
        Parameter("gravity", (0.5, 1.5), condition=conditions.gravity),
    )
)
FAMILY = FamilyConfig(
    episodes=1.2,
    base_success=0.0,
    base_patience=0,
    curriculum=CurriculumConfig(batch=4, sampling=SamplingConfig(candidates=64, pool=16, chains=4)),
    marginal=MarginalConfig(hidden=(8,), steps=2),
    parameterization=ParameterizationConfig(hidden=(8,), steps=2),
)


def _config(folder: Path, **changes) -> TrainConfig:
    settings = {"env": EnvConfig(reward="tracking", time_warp=True), "family": FAMILY}
    return tiny.train_config(folder, **(settings | changes))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    return families.make(_config(tmp_path_factory.mktemp("walker")), SPEC)


@pytest.fixture(scope="module")
def traces() -> list[int]:
    return []


@pytest.fixture(scope="module")
def update(made: Trainer, traces: list[int]) -> Callable[[TrainState], TrainState]:
    def counted(state: TrainState, world):
        traces.append(1)
        return made.update(state, world)

    compiled = jit(counted)
    assert made.world is not None
    world = made.world
    return lambda state: compiled(state, world(state))[0]


@pytest.fixture(scope="module")
def begin(made: Trainer) -> TrainState:
    return jit(made.init)(jax.random.key(0))


def _run(update, state: TrainState, updates: int) -> TrainState:
    for _ in range(updates):
        state = update(state)
    return state


@pytest.mark.timeout(300)
def test_saved_and_restored_families_go_on_bit_for_bit(
    made: Trainer, update, begin: TrainState, traces: list[int], tmp_path: Path
):
    straight = _run(update, begin, 4)
    half = _run(update, begin, 2)
    checkpoint.save(tmp_path, half, int(half.samples))
    restored = checkpoint.restore(tmp_path, made)
    tiny.assert_same_bits(half, restored)
    tiny.assert_same_bits(_run(update, restored, 2), straight)
    assert len(traces) == 1  # other bodies and gravity each time, and never traced again
    assert (
        int(straight.samples)
        == 4 * made.samples
        == 4 * 8 * 4 * families.chunk_count(made.config, made.motion)
    )
    assert int(straight.family.episodes) >= 4 * 8
    for leaf in tiny.leaves((straight.learner, straight.normalizer, straight.family.asked)):
        assert np.isfinite(leaf).all()
    assert not tiny.same_bits(begin.learner, straight.learner)


def test_task_and_speed_keep_their_statistics(made: Trainer, update, begin: TrainState):
    state = _run(update, begin, 1)
    size = state.normalizer.mean.shape[0]
    # Before the one measure come three parameters and the speed.
    rows = slice(size - 5, size - 1)
    np.testing.assert_allclose(state.normalizer.mean[rows], [0.0, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(jnp.sqrt(state.normalizer.var[rows]), 0.3, rtol=1e-6)


def test_a_world_for_each_parameter(made: Trainer, begin: TrainState):
    a = jnp.array([[0.5, 0.5, 0.5], [0.5, 1.0, 0.5], [0.5, 0.0, 0.5], [0.9, 0.5, 1.0]])
    asked = dataclasses.replace(begin.family.asked, a=a)
    state = dataclasses.replace(begin, family=dataclasses.replace(begin.family, asked=asked))
    assert made.world is not None
    world = made.world(state)
    mass = np.asarray(world.body.mass)
    np.testing.assert_allclose(mass[0], mass[3], rtol=1e-6)
    np.testing.assert_allclose(mass[1] / mass[0], [1.0, 1.0, 1.2, 1.2], rtol=1e-5)
    # Legs of 0.5 m: the reference stands 0.1 m higher or lower on them, all the way.
    heights = np.asarray(world.motion.qpos[..., 2])
    np.testing.assert_allclose(heights[0], np.asarray(made.motion.qpos[:, 2]), atol=1e-6)
    np.testing.assert_allclose(heights[1] - heights[0], 0.1, atol=0.02)
    np.testing.assert_allclose(heights[2] - heights[0], -0.1, atol=0.02)


def test_performances_begin_as_the_reference_does(made: Trainer, begin: TrainState):
    """Whatever their motion does in its first knots, whose slope is no speed to begin with."""
    assert made.world is not None and begin.family is not None
    world, own = made.world(begin), families.parts(made.config, SPEC)
    knots = jnp.full((own.knots, own.character.layout.own.nv + 1), 0.1).at[0].set(0.0)
    x = jnp.tile(knots.reshape(-1), (4, 1))
    env = families.environment(own, world, dataclasses.replace(begin.family.asked, x=x, fed=x))
    for phase, same in ((0.0, True), (1.0, False)):
        state = env.start(jnp.float32(phase), jnp.int32(1))
        qvel = motion.sample(own.character.layout, made.motion, phase)[1]
        assert np.allclose(state.sim.qvel, qvel, atol=1e-5) == same


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"envs": 6}, "envs is 6: give a multiple of 4"),
        ({"env": EnvConfig()}, "env.reward is survival: a family needs tracking"),
    ],
)
def test_values_out_of_range_are_named(tmp_path: Path, changes: dict, message: str):
    with pytest.raises(UserError, match=message):
        families.make(_config(tmp_path, **changes), SPEC)


def test_no_task_is_one_skill(tmp_path: Path):
    assert families.make(tiny.train_config(tmp_path)).world is None
    with pytest.raises(UserError, match="task is walk: that recipe has no task"):
        families.make(_config(tmp_path, task="walk"))
