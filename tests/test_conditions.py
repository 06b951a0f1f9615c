# SPDX-License-Identifier: Apache-2.0
"""Conditions change the model as they say: masses, sizes and where things are attached."""

import mujoco
import numpy as np
import pytest

from jaxskills import character
from jaxskills.character import Character
from jaxskills.env import conditions
from jaxskills.env.task import Condition
from jaxskills.errors import UserError

LEG = ("left_hip", "left_knee")


@pytest.fixture(scope="module")
def who() -> Character:
    return character.load("humanoid34")


def changed(who: Character, condition: Condition, factor: float) -> mujoco.MjModel:
    return character.placed(who, [lambda spec: condition(spec, who, factor)], 1 / 120).model


@pytest.mark.parametrize("condition", [conditions.length(LEG), conditions.width(LEG)])
def test_a_factor_of_one_changes_nothing(who: Character, condition: Condition):
    same, before = changed(who, condition, 1.0), character.compile(who, 1 / 120)
    for field in ("body_mass", "body_inertia", "body_pos", "geom_size", "geom_pos"):
        np.testing.assert_allclose(getattr(same, field), getattr(before, field), atol=1e-12)


def test_gravity(who: Character):
    assert changed(who, conditions.gravity, 0.5).opt.gravity[2] == pytest.approx(-4.9)


def test_mass(who: Character):
    heavy = changed(who, conditions.mass(("chest",)), 2.0)
    gained = heavy.body_mass.sum() - who.model.body_mass.sum()
    assert gained == pytest.approx(who.model.body("chest").mass[0])


def test_longer_legs_reach_further_and_weigh_more(who: Character):
    long = changed(who, conditions.length(LEG), 1.5)
    data, before = mujoco.MjData(long), mujoco.MjData(who.model)
    for model, state in ((long, data), (who.model, before)):
        mujoco.mj_kinematics(model, state)
    hip = who.model.body("left_hip").id
    for name, grows in (("left_ankle", True), ("right_ankle", False)):
        body = who.model.body(name).id
        reach = [s.xpos[body] - s.xpos[hip] for s in (data, before)]
        np.testing.assert_allclose(reach[0], (1.5 if grows else 1.0) * reach[1], atol=1e-9)
    for name in LEG:
        ratio = long.body(name).mass[0] / who.model.body(name).mass[0]
        assert ratio == pytest.approx(1.5)
        thick, length = long.geom(name).size[:2] / who.model.geom(name).size[:2]
        assert (thick, length) == (pytest.approx(1.0), pytest.approx(1.5))


def test_wider_legs_weigh_the_square_and_reach_as_far(who: Character):
    wide = changed(who, conditions.width(LEG), 1.5)
    np.testing.assert_allclose(wide.body_pos, who.model.body_pos)
    for name in LEG:
        ratio = wide.body(name).mass[0] / who.model.body(name).mass[0]
        assert ratio == pytest.approx(2.25)
        thick, length = wide.geom(name).size[:2] / who.model.geom(name).size[:2]
        assert (thick, length) == (pytest.approx(1.5), pytest.approx(1.0))
        # A rod turns about its own axis with m r^2 / 2: the fourth power of its thickness.
        about = wide.body(name).inertia.min() / who.model.body(name).inertia.min()
        assert about == pytest.approx(1.5**4, rel=0.05)


def test_unknown_bodies_are_named(who: Character):
    with pytest.raises(UserError, match="unknown body of humanoid34 'leg': choose one of root"):
        changed(who, conditions.width(("leg",)), 1.5)
