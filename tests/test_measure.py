# SPDX-License-Identifier: Apache-2.0
"""Measures of a performance, each kind by hand on a known course; quantities against the engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import kinematics
from jaxskills.character import Character
from jaxskills.env import measure
from jaxskills.env.measure import Measure, Moment
from jaxskills.errors import UserError


def nothing(character: Character) -> measure.Read:
    return lambda moment: jnp.float32(0.0)


def played(made: Measure, course, steps: np.ndarray, seconds: float = 0.1) -> float:
    """Returns the measure of `course(share)` performed in steps that end at these shares."""
    known, before = measure.start(made), 0.0
    for share in steps:
        values = jnp.float32(course(before)), jnp.float32(course(share))
        shares = jnp.float32(before), jnp.float32(share)
        known = measure.update(made, known, *values, shares, seconds)
        before = share
    return float(measure.value(made, known))


EVEN = np.linspace(0.1, 1.0, 10)
UNEVEN = np.array([0.03, 0.2, 0.21, 0.38, 0.5, 0.77, 0.8, 1.0])


@pytest.mark.parametrize("steps", [EVEN, UNEVEN])
def test_a_straight_course_by_hand(steps: np.ndarray):
    line = lambda s: 3.0 + 2.0 * s  # noqa: E731
    assert played(measure.at(0.45, nothing), line, steps) == pytest.approx(3.9)
    assert played(measure.at(1.0, nothing), line, steps) == pytest.approx(5.0)
    assert played(measure.change(nothing, 0.25, 0.85), line, steps) == pytest.approx(1.2)
    assert played(measure.largest(nothing, 0.25, 0.85), line, steps) == pytest.approx(4.7)
    fall = lambda s: -1.0 - s  # noqa: E731
    assert played(measure.largest(nothing, 0.25, 0.85), fall, steps) == pytest.approx(-1.25)


def test_time_is_the_performances():
    # 0.5 to 0.77 takes 0.1 s, of which 0.7 is passed after 20/27; 0.38 to 0.5 another 0.1 s.
    found = played(measure.duration(0.38, 0.7), lambda s: 1.0, UNEVEN)
    assert found == pytest.approx(0.1 + 0.1 * 0.2 / 0.27)
    even = played(measure.total(nothing, 0.2, 0.6), lambda s: 5.0, EVEN)
    assert even == pytest.approx(5.0 * 0.4)
    # Slow until half, then at once: the mean is over time, not over phase.
    steps = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 1.0])
    stair = lambda s: 0.0 if s < 0.5 else 2.0  # noqa: E731
    found = played(measure.mean(nothing, 0.0, 1.0), stair, steps)
    assert found == pytest.approx((0.5 * 2.0 * 0.1 + 2.0 * 0.1) / 0.6)


def test_nothing_is_known_before_and_nothing_changes_after():
    made = measure.at(0.5, nothing)
    before = played(made, lambda s: 7.0, EVEN[:4])
    assert before == 0.0
    assert played(made, lambda s: 7.0 if s <= 0.55 else 100.0, EVEN) == pytest.approx(7.0)


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


def test_quantities_are_the_engines(who: Character):
    rng = np.random.default_rng(3)
    data = mujoco.MjData(who.model)
    data.qpos[:] = tiny.standing()[0]
    mujoco.mj_integratePos(who.model, data.qpos, rng.normal(0, 0.5, who.layout.nv), 1.0)
    data.qvel[:] = rng.normal(0, 2.0, who.layout.nv)
    mujoco.mj_forward(who.model, data)
    mujoco.mj_subtreeVel(who.model, data)
    params = kinematics.body_params(who.model)
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in (data.qpos, data.qvel))
    bodies = kinematics.kinematics(kinematics.tree(who.model), params, qpos, qvel)
    moment = Moment(params, bodies)
    read = lambda quantity: float(quantity(who)(moment))  # noqa: E731
    moved = np.zeros(who.model.nv)
    mujoco.mj_mulM(who.model, data, moved, data.qvel)
    assert read(measure.kinetic_energy) == pytest.approx(0.5 * data.qvel @ moved, rel=1e-3)
    assert read(measure.com_height) == pytest.approx(data.subtree_com[1, 2], abs=1e-4)
    name = who.body_names[2]
    body = who.model.body(name).id
    assert read(measure.height(name)) == pytest.approx(data.xipos[body, 2], abs=1e-4)
    direction = (0.6, -0.8, 0.0)
    assert read(measure.along(name, direction)) == pytest.approx(
        data.xipos[body] @ direction, abs=1e-4
    )
    for i, axis in enumerate(("x", "y", "z")):
        assert read(measure.angular_momentum(axis)) == pytest.approx(
            data.subtree_angmom[1, i], abs=2e-3
        )
        linear = who.mass * data.subtree_linvel[1, i]
        assert read(measure.momentum(axis)) == pytest.approx(linear, abs=1e-2)
        world = data.xmat[body].reshape(3, 3) @ _local_turning(who, data, body)
        assert read(measure.turning(name, axis)) == pytest.approx(world[i], abs=1e-3)


def _local_turning(who: Character, data: mujoco.MjData, body: int) -> np.ndarray:
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(who.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
    return velocity[:3]


@pytest.mark.parametrize(
    "made",
    [
        measure.at(0.0, nothing),
        measure.at(1.2, nothing),
        measure.change(nothing, 0.0, 0.5),
        measure.mean(nothing, 0.6, 0.5),
    ],
)
def test_phases_out_of_order_are_refused(made: Measure):
    with pytest.raises(UserError, match="measure of spin: phases .* in order"):
        measure.validate("spin", made)


def test_it_works_inside_jit():
    made = measure.mean(nothing, 0.2, 0.9)
    step = jax.jit(lambda k, a, b, s, e: measure.update(made, k, a, b, (s, e), 0.1))
    known, before = measure.start(made), 0.0
    for share in EVEN:
        known = step(known, before, share, before, share)
        before = share
    assert float(measure.value(made, known)) == pytest.approx(0.55, abs=1e-4)
