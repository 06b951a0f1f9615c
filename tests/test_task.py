# SPDX-License-Identifier: Apache-2.0
"""Task specifications: what they ask for, what they pay, and which parameter was met instead."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import kinematics
from jaxskills.character import Character
from jaxskills.env import conditions, measure, task
from jaxskills.env.measure import Moment
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.motion import Motion

HEIGHT = Parameter("height", (0.8, 1.6), measure=measure.at(0.5, measure.com_height), sigma=0.2)
TIME = Parameter("time", (1.0, 1.0), measure=measure.duration(0.2, 0.8), sigma=0.2)
GRAVITY = Parameter("gravity", (0.5, 2.0), condition=conditions.gravity)
SPEC = TaskSpec((GRAVITY, HEIGHT, TIME))


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


@pytest.fixture(scope="module")
def made(who: Character, walk: Motion) -> task.Task:
    return task.make(SPEC, who, walk)


def _moment(who: Character, height: float) -> Moment:
    qpos = jnp.asarray(tiny.standing()[0], jnp.float32)
    params = kinematics.body_params(who.model)
    tree = kinematics.tree(who.model)
    bodies = kinematics.kinematics(tree, params, qpos, jnp.zeros(who.layout.nv))
    return Moment(params, bodies.replace(com=bodies.com.at[2].set(height)))


def _play(who: Character, made: task.Task, a: list[float], height: float, steps: int = 30):
    """Returns what is known, and rate and spike of each step, at even speed and this height."""
    known, rows, now = made.start(), [], _moment(who, height)
    for i in range(steps):
        shares = jnp.float32(i / steps), jnp.float32((i + 1) / steps)
        known, rate, spike = made.step(known, now, now, shares, jnp.array(a))
        rows.append((float(rate), float(spike)))
    return known, np.array(rows)


def test_the_reference_measures_itself(walk: Motion, made: task.Task, who: Character):
    height, seconds = made.reference
    assert seconds == pytest.approx(0.6 * walk.seconds, rel=1e-3)
    data = mujoco.MjData(who.model)
    data.qpos[:] = walk.qpos[15]
    mujoco.mj_forward(who.model, data)
    assert float(height) == pytest.approx(data.subtree_com[1, 2], rel=1e-4)
    # Gravity and height of the reference are 1 in units of the range.
    np.testing.assert_allclose(made.base, [0.5 / 1.5, 0.25], atol=1e-6)


def test_the_spike_comes_once_when_everything_is_known(who: Character, made: task.Task):
    height = float(made.reference[0])
    _, rows = _play(who, made, [0.9, 0.25], height)
    assert np.flatnonzero(rows[:, 1]).tolist() == [23] and not rows[:, 0].any()  # at 24/30 = 0.8
    assert rows[23, 1] == pytest.approx(10.0, rel=1e-3)
    # Asked for 1.2 times the height but 1.0 of it reached: one sigma of 0.2, a third of the other.
    _, rows = _play(who, made, [0.9, 0.5], height)
    assert rows[23, 1] == pytest.approx(5.0 * np.exp(-1.0) + 5.0 * np.exp(-1 / 9), rel=1e-3)


def test_without_reach_the_spike_is_that_of_the_paper(who: Character, walk: Motion):
    made = task.make(dataclasses.replace(SPEC, reach=1.0), who, walk)
    _, rows = _play(who, made, [0.9, 0.5], float(made.reference[0]))
    assert rows[23, 1] == pytest.approx(10.0 * np.exp(-1.0), rel=1e-3)


def test_a_constraint_is_asked_for_too(who: Character, made: task.Task):
    """A performance of 60 steps takes twice as long, 5 sigmas off."""
    height = float(made.reference[0])
    known, rows = _play(who, made, [0.9, 0.25], height, steps=60)
    assert rows[:, 1].sum() == pytest.approx(5.0 * np.exp(-25.0 / 9), rel=1e-2)
    assert float(made.hindsight(known, jnp.array([0.9, 0.25]))[1]) == pytest.approx(np.exp(-25.0))


def test_hindsight_keeps_conditions_and_takes_what_was_measured(who: Character, made: task.Task):
    known, _ = _play(who, made, [0.9, 0.1], 1.4 * float(made.reference[0]))
    a, constraint = made.hindsight(known, jnp.array([0.9, 0.1]))
    np.testing.assert_allclose(a, [0.9, 0.75], atol=1e-4)
    assert float(constraint) == pytest.approx(1.0, abs=1e-3)


def test_a_strict_constraint_is_kept_within_its_sigma(who: Character, walk: Motion):
    """Steps of a performance that should take as many as the reference, with a sigma of 0.2."""
    strict = dataclasses.replace(TIME, strict=True)
    for constraint, kept in ((strict, (False, True, True, False)), (TIME, (True,) * 4)):
        made = task.make(TaskSpec((HEIGHT, constraint)), who, walk)
        found = [_play(who, made, [0.25], 1.0, steps)[0] for steps in (22, 26, 35, 40)]
        assert tuple(bool(made.kept(known)) for known in found) == kept


def test_a_parameter_may_be_a_condition_and_measured(who: Character, walk: Motion):
    both = dataclasses.replace(HEIGHT, condition=conditions.gravity)
    spec = TaskSpec((both,))
    made = task.make(spec, who, walk)
    np.testing.assert_allclose(made.base, [0.25], atol=1e-6)
    known, _ = _play(who, made, [0.9], 1.4 * float(made.reference[0]))
    assert made.hindsight(known, jnp.array([0.9]))[0].tolist() == pytest.approx([0.75], abs=1e-4)
    assert task.variant(spec, who, np.array([1.0])).model.opt.gravity[2] == pytest.approx(-15.696)


def test_objects_stand_there_whatever_the_parameters(who: Character):
    def halved(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        assert factor == 1.0
        spec.option.gravity = [0.0, 0.0, -4.0]

    spec = TaskSpec((GRAVITY,), scenery=(halved,))
    among = task.placed(spec, who)
    assert among.model.opt.gravity[2] == -4.0 and who.model.opt.gravity[2] == -9.81
    assert task.variant(spec, among, np.array([1.0])).model.opt.gravity[2] == -8.0
    fine = task.variant(spec, among, np.array([0.0]), timestep=0.001).model
    assert (fine.opt.gravity[2], fine.opt.timestep) == (-2.0, 0.001)


def test_a_continuous_parameter_pays_on_the_way(who: Character, walk: Motion):
    steady = Parameter(
        "height",
        (0.8, 1.6),
        measure=measure.mean(measure.com_height, 0.2, 0.8),
        sigma=0.2,
        continuous=True,
    )
    made = task.make(TaskSpec((steady,)), who, walk)
    _, rows = _play(who, made, [0.25], float(made.reference[0]))
    paid = np.flatnonzero(rows[:, 0])
    assert (paid[0], paid[-1], rows[:, 1].any()) == (5, 23, False)
    np.testing.assert_allclose(rows[paid, 0], 0.1, rtol=1e-4)


def test_the_policy_sees_the_parameter_and_what_is_known(who: Character, made: task.Task):
    known, _ = _play(who, made, [0.9, 0.25], float(made.reference[0]))
    seen = made.observe(known, jnp.array([0.9, 0.25]))
    np.testing.assert_allclose(seen, [0.9, 0.25, 1.0, 1.0], atol=1e-3)


def test_a_task_without_measures(who: Character, walk: Motion):
    made = task.make(TaskSpec((GRAVITY,)), who, walk)
    known, rows = _play(who, made, [0.5], 1.0)
    assert known.shape == (0, 2) and not rows.any()
    a, constraint = made.hindsight(known, jnp.array([0.5]))
    assert (float(a[0]), float(constraint)) == (0.5, 0.0)


def test_units_there_and_back():
    a = task.from_units(SPEC, {"height": 1.2, "gravity": 2.0})
    np.testing.assert_allclose(a, [1.0, 0.5])
    assert task.in_units(SPEC, a) == pytest.approx({"gravity": 2.0, "height": 1.2})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"hieght": 1.0}, "unknown task parameter 'hieght': choose one of gravity, height"),
        ({"height": 1.0}, "task parameter gravity is missing: give it a value"),
        ({"height": 2.0, "gravity": 1.0}, "task parameter height is 2.0: give 0.8 to 1.6"),
    ],
)
def test_wrong_values_are_refused(values: dict[str, float], message: str):
    with pytest.raises(UserError) as raised:
        task.from_units(SPEC, values)
    assert str(raised.value) == message


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ((HEIGHT, HEIGHT), "height comes twice"),
        ((Parameter("x", (2.0, 1.0), condition=conditions.gravity),), "two numbers in order"),
        ((Parameter("x", (1.0, 2.0)),), "x: give a measure, a condition, or both"),
        (
            (Parameter("x", (1.0, 1.0), condition=conditions.gravity),),
            "needs a measure, and no con",
        ),
        ((dataclasses.replace(TIME, condition=conditions.gravity),), "needs a measure, and no con"),
        ((dataclasses.replace(HEIGHT, strict=True),), "height: strict is for a range of no width"),
        (
            (Parameter("x", (1.0, 2.0), measure=HEIGHT.measure, sigma=0.0),),
            "sigma 0.0: give a positive number",
        ),
    ],
)
def test_broken_specifications_are_refused(parameters: tuple[Parameter, ...], message: str):
    with pytest.raises(UserError, match=message):
        task.validate(TaskSpec(parameters))


def test_half_of_the_reward_is_not_narrower_than_the_other():
    with pytest.raises(UserError, match="reach 0.5: give 1 or more"):
        task.validate(TaskSpec((HEIGHT,), reach=0.5))


def test_what_the_reference_has_nothing_of_has_no_multiples(who: Character, walk: Motion):
    still = Parameter("spin", (0.5, 2.0), measure=measure.total(lambda c: lambda m: 0.0, 0.2, 0.8))
    with pytest.raises(UserError, match="no multiples: give an absolute range"):
        task.make(TaskSpec((still,)), who, walk)
