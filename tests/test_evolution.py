# SPDX-License-Identifier: Apache-2.0
"""Initial state evolution: elites stay in their segment, are different, and get better."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills import motion as motion_lib
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.explore import evolution
from jaxskills.explore.evolution import Elites, EvolutionConfig, Visited
from jaxskills.motion import Motion

SEGMENTS = 5
CONFIG = EvolutionConfig(elites=8)


@pytest.fixture(scope="module")
def elites(who: Character, walk: Motion) -> Elites:
    return evolution.init(CONFIG, who.layout, walk, SEGMENTS)


def _visited(phase: np.ndarray, value: np.ndarray) -> Visited:
    count = len(phase)
    qpos = jnp.tile(jnp.arange(count, dtype=jnp.float32)[:, None], (1, 13))
    return Visited(qpos, jnp.zeros((count, 11)), jnp.asarray(phase), jnp.asarray(value))


def test_the_first_elites_are_the_reference(elites: Elites, who: Character, walk: Motion):
    assert elites.phase.shape == (SEGMENTS, 8)
    expected = jnp.arange(SEGMENTS * 8) / (SEGMENTS * 8) * walk.length
    np.testing.assert_allclose(elites.phase.reshape(-1), expected, rtol=1e-6)
    qpos, qvel = motion_lib.sample(who.layout, walk, elites.phase[2, 3])
    np.testing.assert_allclose(elites.qpos[2, 3], qpos, atol=1e-6)
    np.testing.assert_allclose(elites.qvel[2, 3], qvel, atol=1e-6)


def test_elites_stay_in_their_segment_and_are_different(elites: Elites, walk: Motion):
    random = np.random.default_rng(0)
    phase = random.uniform(0, float(walk.length), 300).astype(np.float32)
    visited = _visited(phase, random.normal(size=300).astype(np.float32))
    after = evolution.update(CONFIG, elites, visited, jax.random.key(0), walk.length)
    place = np.floor(np.asarray(after.phase) / float(walk.length) * SEGMENTS)
    np.testing.assert_array_equal(place, np.tile(np.arange(SEGMENTS)[:, None], (1, 8)))
    for row in np.asarray(after.phase):
        assert len(np.unique(row)) == 8


def test_good_states_replace_bad_ones(elites: Elites, walk: Motion):
    """100 states of value 10 in segment 1 against 8 elites of value 0: chances e^3 : 1 each."""
    phase = np.linspace(0.21, 0.39, 100, dtype=np.float32) * float(walk.length)
    visited = _visited(phase, np.full(100, 10.0, np.float32))
    after = evolution.update(CONFIG, elites, visited, jax.random.key(1), walk.length)
    assert (np.asarray(after.value[1]) == 10.0).all()
    for segment in (0, 2, 3, 4):  # nothing was visited there
        np.testing.assert_allclose(
            np.sort(after.phase[segment]), np.sort(elites.phase[segment]), rtol=1e-6
        )


def test_chances_are_boltzmanns():
    """Values 0 and 1, greed 3, one elite: 1 is drawn with 1 / (1 + exp(-3 / 1.01)) = 0.951."""
    keys = jax.random.split(jax.random.key(2), 4000)
    value, member = jnp.array([0.0, 1.0]), jnp.array([True, True])
    drawn = jax.vmap(lambda key: evolution._choose(3.0, value, member, key, 1)[0])(keys)
    assert float(drawn.mean()) == pytest.approx(1 / (1 + np.exp(-3 / 1.01)), abs=0.015)


def test_values_fade(elites: Elites, walk: Motion):
    old = elites.replace(value=jnp.ones_like(elites.value))
    none = _visited(np.zeros(1, np.float32), np.array([np.nan], np.float32))
    after = evolution.update(CONFIG, old, none, jax.random.key(0), walk.length)
    np.testing.assert_allclose(after.value, 0.95, rtol=1e-6)
    assert np.isfinite(after.qpos).all()


def test_starts_are_elites_with_noisy_joints(elites: Elites, who: Character):
    segment = jnp.array([0, 3, 3, 4])
    phase, qpos, qvel = evolution.draw(CONFIG, who.layout, elites, jax.random.key(0), segment)
    for i, k in enumerate(np.asarray(segment)):
        row = int(np.argmin(np.abs(elites.phase[k] - phase[i])))
        np.testing.assert_allclose(qpos[i, :7], elites.qpos[k, row, :7], atol=1e-6)
        np.testing.assert_allclose(qvel[i], elites.qvel[k, row])
        moved = np.abs(np.asarray(qpos[i, 11:] - elites.qpos[k, row, 11:]))
        assert 0 < moved.max() < 0.3


@pytest.mark.parametrize("cycles", [0, 1, 7])
def test_folding_undoes_cycles(who: Character, walk: Motion, cycles: int):
    phase = jnp.float32(0.3) * walk.length
    qpos, qvel = motion_lib.sample(who.layout, walk, phase + cycles * walk.length)
    folded = motion_lib.fold(who.layout, walk, qpos, qvel, phase + cycles * walk.length)
    expected = (*motion_lib.sample(who.layout, walk, phase), phase)
    for found, wanted in zip(folded, expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-4)


def test_out_of_range():
    for name, value in (("elites", 0), ("decay", 1.5), ("noise", -1.0), ("greed", float("nan"))):
        with pytest.raises(UserError, match=f"evolution.{name} is"):
            evolution.validate(EvolutionConfig(**{name: value}))
