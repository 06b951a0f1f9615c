# SPDX-License-Identifier: Apache-2.0
"""Families and skills among things: what the trainer makes of a task with obstacles and holds."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import families
from jaxskills.env import measure, obstacles
from jaxskills.env.core import EnvConfig
from jaxskills.env.holds import Grip
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.explore.curriculum import CurriculumConfig
from jaxskills.explore.family import FamilyConfig
from jaxskills.trainer import Trainer

SLOW = pytest.mark.slow  # making a family compiles for a minute

_ALONG = measure.change(measure.com_along((1.0, 0.0, 0.0)), 0.1, 0.9)

# The walk begins on the first box and gets to the second, held at the torso by a bar.
SPEC = TaskSpec(
    (
        Parameter(
            "step",
            (-0.4, 0.4),
            measure=measure.change(measure.com_height, 0.1, 0.9),
            condition=obstacles.step("first", "second"),
            relative=False,
        ),
        Parameter("far", (1.0, 1.0), measure=_ALONG, strict=True),
    ),
    scenery=(
        obstacles.box((0.0, 0.0), (0.6, 1.0), 0.0, "first"),
        obstacles.box((1.0, 0.0), (0.6, 1.0), 0.0, "second"),
        obstacles.bar((0.25, 0.0), 0.7, grip=Grip(("torso",), 0.4, 0.6)),
    ),
)


@pytest.fixture(scope="module")
def family(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    few = FamilyConfig(curriculum=CurriculumConfig(batch=4))
    config = tiny.train_config(
        tmp_path_factory.mktemp("family"),
        family=few,
        env=EnvConfig(reward="tracking", time_warp=True),
    )
    return families.make(config, SPEC)


@SLOW
@pytest.mark.timeout(1800)
def test_each_variant_has_its_own_ground_and_level(family: Trainer):
    state = jax.eval_shape(family.init, jax.random.key(0))
    assert family.world is not None and state.family is not None
    a = jnp.array([[0.0], [0.25], [0.5], [1.0]])
    asked = dataclasses.replace(state.family.asked, a=a)
    at = family.world(dataclasses.replace(state.family, asked=asked))
    assert at.shapes.boxes is not None and at.holds is not None
    np.testing.assert_allclose(
        at.shapes.boxes.top, [[0.4, -1.0], [0.2, -1.0], [-1.0, -1.0], [-1.0, 0.4]], atol=1e-6
    )
    lift = at.motion.qpos[:, :, 2] - family.motion.qpos[:, 2]
    np.testing.assert_allclose(lift, np.outer([0.4, 0.2, 0.0, 0.0], np.ones(31)), atol=1e-6)
    np.testing.assert_allclose(at.holds.middle, [[[0.25, 0.0, 0.7]]] * 4, atol=1e-6)


@SLOW
@pytest.mark.timeout(1800)
def test_an_update_is_sound(family: Trainer):
    """It can be traced, and gives back a state of the same kind."""
    key = jax.random.key(0)
    state = jax.eval_shape(family.init, key)
    assert family.world is not None and state.family is not None
    asked = dataclasses.replace(state.family.asked, a=jnp.full((4, 1), 0.5))
    at = family.world(dataclasses.replace(state.family, asked=asked))
    after, metrics = jax.eval_shape(family.update, state, at)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(
        lambda x: (x.shape, x.dtype), state
    )
    assert "explored" in metrics


def test_a_skill_among_objects(tmp_path: Path):
    """A task without parameters is one skill, and its reference begins on what stands there."""
    objects = (obstacles.box((0.0, 0.0), (0.6, 1.0), 0.3),)
    config = tiny.train_config(tmp_path)
    made = families.make(config, TaskSpec(scenery=objects))
    assert made.world is None
    assert [made.character.model.geom("box").pos[0]] == [0.0]
    plain = families.make(config)
    lift = made.motion.qpos[:, 2] - plain.motion.qpos[:, 2]
    np.testing.assert_allclose(lift, 0.3, atol=1e-6)
