# SPDX-License-Identifier: Apache-2.0
"""The imitation reward: 1 on the reference, and numbers worked out by hand."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.character import Character
from jaxskills.env import rewards
from jaxskills.kinematics import Bodies


def _bodies(com_vel) -> Bodies:
    none = jnp.zeros((4, 3))
    return Bodies(none, jnp.zeros((4, 3, 3)), none, none, jnp.zeros(3), jnp.array(com_vel))


def _reward(
    who: Character,
    offset=(),
    velocity=(),
    effectors=((0.0, 0.0, 0.0),) * 3,
    com_vel=(0.0, 0.0, 0.0),
) -> float:
    """Returns the reward for errors given as (index, value) pairs and plain vectors."""
    rows = np.zeros((2, who.layout.nv))
    for row, pairs in zip(rows, (offset, velocity), strict=True):
        for index, value in pairs:
            row[index] = value
    off = jnp.array(effectors, float).reshape(-1, 3)
    here = jnp.ones_like(off)
    return float(
        rewards.imitation(
            rewards.imitation_weights(who),
            jnp.asarray(rows[0]),
            jnp.asarray(rows[1]),
            (here, here + off),
            _bodies((1.0, 2.0, 3.0)),
            _bodies(np.add((1.0, 2.0, 3.0), com_vel)),
        )
    )


def test_weights_are_the_joints_shares(who: Character):
    """Weights 1 (root), 1 (spine), 0.5 and 0.5 (hips) of 3 in all; a joint's axes share one."""
    weights = rewards.imitation_weights(who)
    np.testing.assert_allclose(weights.root_weight, 1 / 3)
    np.testing.assert_allclose(weights.dof_weight, [1 / 3, 1 / 3, 1 / 3, 1 / 6, 1 / 6], rtol=1e-6)


def test_the_reference_is_worth_one(who: Character):
    assert _reward(who) == pytest.approx(1.0, abs=1e-6)


def test_one_by_hand(who: Character):
    """Root 0.1 m up and 0.3 rad, spine (0.3, 0, 0.4) rad, left hip 0.6 rad: (0.09 + 0.25) / 3 +
    0.36 / 6 = 0.17333; hips 1 and 2 rad/s: (1 + 4) / 6; one effector 0.1 and one 0.2 m off:
    0.05 / 3; the root besides, at 2 m/s and 3 rad/s: 0.01 + 0.1 0.09 + 0.01 4 + 0.001 9 = 0.068,
    which makes the velocity term (1 + 4) / 6 + 9 / 3; the centre of mass 0.5 m/s: 0.25."""
    found = _reward(
        who,
        offset=[(2, -0.1), (4, 0.3), (6, 0.3), (8, 0.4), (9, 0.6)],
        velocity=[(0, 2.0), (5, 3.0), (9, 1.0), (10, -2.0)],
        effectors=((0.1, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -0.2)),
        com_vel=(0.0, 0.5, 0.0),
    )
    # 0.5 e^-0.34667 + 0.05 e^-0.38333 + 0.15 e^-0.66667 + 0.2 e^-0.34 + 0.1 e^-0.25
    assert found == pytest.approx(0.35352 + 0.03408 + 0.07701 + 0.14235 + 0.07788, abs=2e-5)


@pytest.mark.parametrize(
    ("errors", "lost"),
    [
        ({"offset": [(7, 30.0)]}, ("pose",)),
        ({"offset": [(3, 30.0)]}, ("pose", "root")),
        ({"offset": [(2, 3.0)]}, ("root",)),
        ({"velocity": [(8, 300.0)]}, ("velocity",)),
        ({"velocity": [(5, 300.0)]}, ("velocity", "root")),
        ({"velocity": [(1, 30.0)]}, ("root",)),
        ({"effectors": ((9.0, 0.0, 0.0),) * 3}, ("end_effectors",)),
        ({"com_vel": (9.0, 0.0, 0.0)}, ("com",)),
    ],
)
def test_each_large_error_costs_the_weights_of_its_terms(
    who: Character, errors: dict, lost: tuple[str, ...]
):
    kept = 1.0 - sum(rewards.TERMS[name] for name in lost)
    assert _reward(who, **errors) == pytest.approx(kept, abs=1e-5)


def test_a_character_without_end_effectors_has_a_reward_too(who: Character):
    assert _reward(who, effectors=()) == pytest.approx(1.0, abs=1e-6)


def test_where_the_root_is_horizontally_costs_nothing(who: Character):
    assert _reward(who, offset=[(0, 5.0), (1, -3.0)]) == pytest.approx(1.0)


def test_terms_are_those_of_deepmimics_code():
    shares = {"pose": 0.5, "velocity": 0.05, "end_effectors": 0.15, "root": 0.2, "com": 0.1}
    assert shares == rewards.TERMS
    assert math.isclose(sum(rewards.TERMS.values()), 1.0)
