# SPDX-License-Identifier: Apache-2.0
"""A family between updates: when it leaves the reference, what it takes in and asks for."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.errors import UserError
from jaxskills.explore import curriculum, family
from jaxskills.explore import elites as elites_lib
from jaxskills.explore.curriculum import CurriculumConfig
from jaxskills.explore.elites import EliteConfig, Episodes
from jaxskills.explore.family import Family, FamilyConfig, Results
from jaxskills.explore.parameterization import ParameterizationConfig
from jaxskills.explore.sampling import SamplingConfig

SIZE, STATES = 6, 64
# A threshold of 0: motions are those of the elites themselves, never the network's.
CONFIG = FamilyConfig(
    parameterization=ParameterizationConfig(threshold=0.0),
    curriculum=CurriculumConfig(
        batch=8, sampling=SamplingConfig(candidates=512, pool=64, chains=8)
    ),
)


def _results(a: list[float], success: float = 1.0, reward: float = 0.9, fitness: float = 1.0):
    """Returns one episode for each of `a [Q, 1]`, whose motion is `a` everywhere."""
    rows = jnp.array(a)[:, None]
    fitness = jnp.full(len(a), fitness)
    episodes = Episodes(rows, jnp.tile(rows, (1, SIZE)), fitness, fitness, rows[:, 0] > -9)
    states = jnp.tile(rows[:1], (STATES, 1))
    owner = jnp.arange(len(a), dtype=jnp.int32) % 8
    counts = jnp.float32(30), jnp.float32(success), jnp.float32(reward)
    return Results(episodes, owner, states, jnp.full(STATES, 0.5), *counts)


def _begin() -> Family:
    return family.init(CONFIG, jnp.array([0.4]), SIZE, jax.random.key(0))


UPDATE = jax.jit(lambda state, results, key: family.update(CONFIG, state, results, key))


def test_only_the_reference_is_asked_for_until_it_is_learnt():
    state = _begin()
    np.testing.assert_array_equal(state.asked.a, np.full((8, 1), 0.4, np.float32))
    assert not state.asked.x.any()
    # The mean of the rewards grows for a while; some updates without growth, and it explores.
    rewards = [0.5, 0.6, 0.7, 0.8] + [0.8] * 30
    learnt = []
    for i, reward in enumerate(rewards):
        state, _ = UPDATE(state, _results([0.4], reward=reward), jax.random.key(i))
        learnt.append(bool(state.base.learnt))
        still = bool((state.asked.a == jnp.float32(0.4)).all())
        assert still != learnt[-1]
    assert not any(learnt[:7]) and learnt[-1]
    assert int(state.episodes) == 30 * len(rewards)


def test_the_reference_is_not_learnt_while_episodes_fail():
    state = _begin()
    for i in range(20):
        state, _ = UPDATE(state, _results([0.4], success=0.7), jax.random.key(i))
    assert not bool(state.base.learnt)


def test_it_asks_around_its_elites_for_their_motion():
    state = _begin()
    for i in range(8):
        state, seen = UPDATE(state, _results([0.25, 0.4, 0.55]), jax.random.key(i))
    assert bool(state.base.learnt)
    assert int(seen["elites"]) == 3 and int(seen["counted"]) == 0
    asked = np.asarray(state.asked.a)[:, 0]
    assert ((asked > 0.05) & (asked < 0.75)).all() and np.ptp(asked) > 0.05
    # An elite's motion is its parameter, throughout.
    motion = np.asarray(state.asked.x)
    np.testing.assert_allclose(motion, np.tile(asked[:, None], motion.shape[1]), atol=0.03)
    # What is fed forward is that without the performance of the reference, which is 0.4.
    np.testing.assert_allclose(state.asked.fed, motion - 0.4, atol=1e-3)
    best = family.best(CONFIG, state, jnp.array([[0.5], [0.4]]))
    np.testing.assert_allclose(best.x[:, 0], [0.5, 0.4], atol=0.03)
    np.testing.assert_allclose(best.fed, best.x - 0.4, atol=1e-3)


def test_new_elites_count_for_whoever_was_asked():
    state = _begin()
    for i in range(8):
        state, _ = UPDATE(state, _results([0.4]), jax.random.key(i))
    before = state.curriculum.rate
    state, seen = UPDATE(state, _results([0.4, 0.8, 0.6]), jax.random.key(9))
    assert (int(seen["entered"]), int(seen["counted"])) == (2, 2)
    assert float(jnp.abs(state.curriculum.rate - before).sum()) > 0.0


def test_what_is_far_below_the_elites_is_no_success():
    """Two of four have half the fitness of the elite nearest to what was asked: 0.5, 0.6 or 0.7."""
    kept = _results([0.1, 0.4, 0.7]).episodes
    keep = family.roomy(CONFIG.elites, 1)
    none = elites_lib.init(keep, 1, SIZE)
    fit = dataclasses.replace(kept, fitness=jnp.array([0.5, 0.6, 0.7]))
    elites, _, _ = elites_lib.insert(keep, none, fit)
    many = _results([0.5, 0.5, 0.5, 0.5, 0.5]).episodes
    many = dataclasses.replace(
        many,
        fitness=jnp.array([0.26, 0.24, 0.34, 0.31, 0.0]),
        valid=jnp.array([True, True, True, True, False]),
    )
    asked = jnp.array([[0.1], [0.2], [0.9], [0.45], [0.5]])
    assert float(family.good(CONFIG, elites, many, asked)) == pytest.approx(0.5)
    assert float(family.good(CONFIG, none, many, asked)) == 1.0
    state = _begin()
    for i in range(8):
        state, _ = UPDATE(state, _results([0.25, 0.4, 0.55]), jax.random.key(i))
    assert int(state.curriculum.phase) == curriculum.EXPLORATION
    for i in range(8):
        poor = _results([0.25, 0.4, 0.55], fitness=0.4)
        state, _ = UPDATE(state, poor, jax.random.key(20 + i))
    assert int(state.curriculum.phase) == curriculum.REFINEMENT


def test_no_more_rows_than_can_be_filled():
    keep = EliteConfig(capacity=10_000, radius=0.1)
    assert [family.roomy(keep, p).capacity for p in (1, 2, 3, 4)] == [256, 484, 5324, 10_000]
    assert family.roomy(EliteConfig(capacity=50), 4).capacity == 50
    points = np.random.default_rng(0).uniform(-0.1, 1.1, (2000, 2)).astype(np.float32)
    ones = jnp.ones(2000)
    many = Episodes(jnp.asarray(points), jnp.zeros((2000, 1)), ones, ones, ones > 0)
    roomy = family.roomy(keep, 2)
    elites, _, _ = elites_lib.insert(roomy, elites_lib.init(roomy, 2, 1), many)
    assert int(elites.used.sum()) < roomy.capacity


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("episodes", 0.5),
        ("late", 1.0),
        ("base_success", -0.1),
    ],
)
def test_values_out_of_range_are_named(name: str, value: float):
    with pytest.raises(UserError, match=f"family.{name} is {value}"):
        family.validate(dataclasses.replace(CONFIG, **{name: value}))
