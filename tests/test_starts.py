# SPDX-License-Identifier: Apache-2.0
"""Where episodes begin: SB eq. 11 against plain numpy, and the running averages by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.errors import UserError
from jaxskills.explore import starts
from jaxskills.explore.starts import Starts, StartsConfig


def _known(*returns: float) -> Starts:
    return Starts(jnp.array(returns), jnp.ones(len(returns), bool))


def _equation_11(returns: list[float], u: float) -> list[float]:
    """SB eq. 11 as printed, one segment after the other."""
    v = (max(returns) - min(returns)) / 3.0
    weights = [np.exp(-w / v) for w in returns]
    return [(1.0 - u) * x / sum(weights) + u / len(returns) for x in weights]


@pytest.mark.parametrize("uniform", [0.0, 0.2, 0.7])
@pytest.mark.parametrize(
    "returns", [[3.0, 1.0, 2.0, 8.0], [-1.0, -1.5], [0.0, 0.0, 1.0], [50.0, 49.0, 48.9]]
)
def test_probabilities_are_those_of_equation_11(returns: list[float], uniform: float):
    found = np.asarray(starts.probabilities(_known(*returns), uniform))
    np.testing.assert_allclose(found, _equation_11(returns, uniform), rtol=1e-4)
    np.testing.assert_allclose(found.sum(), 1.0, rtol=1e-6)
    assert found.argmax() == np.argmin(returns)


@pytest.mark.parametrize(
    ("returns", "uniform"), [((3.0, 1.0, 2.0, 8.0), 1.0), ((2.0, 2.0, 2.0, 2.0), 0.2), ((), 0.2)]
)
def test_uniform_at_u_1_and_where_no_segment_is_worse(returns: tuple[float, ...], uniform: float):
    known = _known(*returns) if returns else starts.init(StartsConfig(segments=4))
    np.testing.assert_allclose(starts.probabilities(known, uniform), 0.25, rtol=1e-6)


def test_the_scale_of_returns_does_not_matter():
    small = starts.probabilities(_known(1.0, 2.0, 4.0), 0.1)
    large = starts.probabilities(_known(100.0, 200.0, 400.0), 0.1)
    np.testing.assert_allclose(small, large, rtol=1e-4)


def test_segments_not_seen_count_as_average():
    seen = jnp.array([True, True, False, False])
    found = starts.probabilities(Starts(jnp.array([1.0, 5.0, 0.0, 99.0]), seen), 0.2)
    np.testing.assert_allclose(found, _equation_11([1.0, 5.0, 3.0, 3.0], 0.2), rtol=1e-5)


def test_segments_are_drawn_as_often_as_they_should_and_evenly_inside():
    config, known = StartsConfig(segments=4, uniform=0.2), _known(1.0, 3.0, 2.0, 8.0)
    phase = np.asarray(starts.sample(config, known, jax.random.key(0), 40_000, 30.0))
    assert phase.min() >= 0.0
    assert phase.max() < 30.0
    share = np.bincount((phase / 7.5).astype(int), minlength=4) / len(phase)
    np.testing.assert_allclose(share, starts.probabilities(known, 0.2), atol=0.01)
    inside = np.histogram(phase[phase < 7.5], bins=5, range=(0.0, 7.5))[0]
    np.testing.assert_allclose(inside / inside.sum(), 0.2, atol=0.02)


def test_running_averages_by_hand():
    """Segments of 10 frames, memory 0.75. First means as they are, later ones blended."""
    config, every = StartsConfig(segments=3, memory=0.75), jnp.ones(3, bool)
    phase, returns = jnp.array([1.0, 9.0, 12.0]), jnp.array([4.0, 8.0, 5.0])
    first = starts.update(config, starts.init(config), phase, returns, every, 30.0)
    np.testing.assert_allclose(first.returns, [6.0, 5.0, 0.0], rtol=1e-6)
    assert first.seen.tolist() == [True, True, False]
    # 0.75 * 6 + 0.25 * 2; two episodes begun in the second: 0.75^2 * 5 + (1 - 0.75^2) * 3.
    phase, returns = jnp.array([3.0, 12.0, 18.0]), jnp.array([2.0, 1.0, 5.0])
    later = starts.update(config, first, phase, returns, every, 30.0)
    np.testing.assert_allclose(later.returns, [5.0, 4.125, 0.0], rtol=1e-6)


def test_only_what_an_episode_begins_with_counts():
    config = StartsConfig(segments=2, memory=0.5)
    before = starts.Starts(jnp.array([8.0, 8.0]), jnp.ones(2, bool))
    phase, returns = jnp.array([1.0, 2.0, 12.0, 13.0]), jnp.array([2.0, 50.0, 50.0, 50.0])
    first = jnp.array([True, False, False, False])
    after = starts.update(config, before, phase, returns, first, 20.0)
    np.testing.assert_allclose(after.returns, [5.0, 8.0], rtol=1e-6)


def test_later_cycles_fall_into_the_same_segments():
    config = StartsConfig(segments=3)
    phase = jnp.array([35.0, 30.0 + 15.0, 300.0 + 29.9])
    returns = jnp.array([1.0, 2.0, 3.0])
    found = starts.update(config, starts.init(config), phase, returns, jnp.ones(3, bool), 30.0)
    np.testing.assert_allclose(found.returns, [1.0, 2.0, 3.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (StartsConfig(segments=0), "starts.segments is 0: give 1 or more"),
        (StartsConfig(uniform=1.1), "starts.uniform is 1.1: give 0 to 1"),
        (StartsConfig(uniform=-0.1), "starts.uniform is -0.1: give 0 to 1"),
        (StartsConfig(memory=2.0), "starts.memory is 2.0: give 0 to 1"),
    ],
)
def test_what_is_out_of_range_is_refused(config: StartsConfig, message: str):
    with pytest.raises(UserError) as raised:
        starts.validate(config)
    assert str(raised.value) == message
