# SPDX-License-Identifier: Apache-2.0
"""References start on the ground that is there, whatever the body's size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import ground, kinematics, levels
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import conditions, obstacles, task
from jaxskills.env.task import Condition, Parameter, TaskSpec
from jaxskills.motion import Motion


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


def _motion(who: Character) -> Motion:
    """Poses that rise by 0.1 m and go 1 m forward."""
    qpos = tiny.standing(4)
    qpos[:, 0], qpos[:, 2] = np.linspace(0.0, 1.0, 4), 0.52 + np.linspace(0.0, 0.1, 4)
    return tiny.make_motion(who, qpos, False)


@pytest.mark.parametrize(
    ("x", "height", "raised"),
    [
        (0.0, 0.4, 0.4),  # begins on the box
        (0.0, 0.0, 0.0),  # of no height
        (1.0, 0.4, 0.0),  # gets to it later
        (0.6, 0.4, 0.4),  # begins with the toes on it
    ],
)
def test_a_motion_is_higher_by_the_box_that_it_begins_on(
    plain: Character, x: float, height: float, raised: float
):
    box = obstacles.box((x, 0.0), (1.0, 1.0), height)
    motion = _motion(plain)
    found = levels.raised(task.placed(TaskSpec(scenery=(box,)), plain), motion)
    np.testing.assert_allclose(found.qpos[:, 2], motion.qpos[:, 2] + raised, atol=1e-6)
    np.testing.assert_array_equal(found.qpos[:, :2], motion.qpos[:, :2])
    np.testing.assert_array_equal(found.qvel, motion.qvel)


def test_without_boxes_it_is_the_very_same(plain: Character):
    motion = _motion(plain)
    assert levels.raised(plain, motion) is motion


def _variants(who: Character, condition: Condition, factors: tuple[float, ...]) -> Motion:
    low, high = min(factors), max(factors)
    spec = TaskSpec((Parameter("p", (low, high), condition=condition),))
    models = [task.variant(spec, who, np.array([(f - low) / (high - low)])).model for f in factors]
    own = [(kinematics.body_params(m), ground.shapes(m)) for m in (who.model, *models)]
    others = jax.tree.map(lambda *x: jnp.stack(x), *own[1:])
    shown = levels.raised(who, _motion(who))
    return jit(lambda: levels.of_variants(kinematics.tree(who.model), shown, own[0], others))()


def test_variants_begin_on_boxes_of_their_own(plain: Character):
    motion = _motion(plain)
    found = _variants(plain, obstacles.box((0.0, 0.0), (1.0, 1.0), 1.0), (0.0, 0.25, 0.5))
    for i, top in enumerate((0.0, 0.25, 0.5)):
        np.testing.assert_allclose(found.qpos[i, :, 2], motion.qpos[:, 2] + top, atol=1e-6)
        np.testing.assert_allclose(found.qvel[i], motion.qvel, atol=1e-4)


def test_a_box_that_all_begin_on_counts_once(plain: Character):
    among = task.placed(TaskSpec(scenery=(obstacles.box((0.0, 0.0), (1.0, 1.0), 0.3),)), plain)
    found = _variants(among, conditions.gravity, (0.5, 1.0))
    expected = _motion(plain).qpos[:, 2] + 0.3
    np.testing.assert_allclose(found.qpos[:, :, 2], np.tile(expected, (2, 1)), atol=1e-6)


def test_longer_legs_are_as_far_over_the_ground(plain: Character):
    """Feet end 0.5 m below the hips, 0.6 m when 1.2 times as long; soles grow to 0.024 m."""
    found = _variants(plain, conditions.length(("left_leg", "right_leg")), (1.0, 1.2))
    lift = found.qpos[:, :, 2] - _motion(plain).qpos[:, 2]
    np.testing.assert_allclose(lift[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(lift[1], 0.1, atol=0.005)
