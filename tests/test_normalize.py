# SPDX-License-Identifier: Apache-2.0
"""Running statistics against numpy on everything seen."""

import jax.numpy as jnp
import numpy as np

from jaxskills.learn import normalize
from jaxskills.learn.normalize import Normalizer


def _seen(*batches: np.ndarray) -> Normalizer:
    state = normalize.init(batches[0].shape[1])
    for batch in batches:
        state = normalize.update(state, jnp.asarray(batch, jnp.float32))
    return state


def test_statistics_are_those_of_all_batches_together():
    rng = np.random.default_rng(0)
    scale, middle = np.array([1.0, 1e-2, 300.0]), np.array([5.0, -1.0, 1e3])
    batches = [
        middle + drift + scale * rng.normal(size=(count, 3))
        for count, drift in ((1, 0.0), (50, 0.3), (7, -2.0), (400, 1.0))
    ]
    found, everything = _seen(*batches), np.concatenate(batches)
    assert float(found.count) == 458
    np.testing.assert_allclose(found.mean, everything.mean(0), rtol=1e-4)
    np.testing.assert_allclose(found.var, everything.var(0), rtol=1e-3)


def test_the_order_of_batches_does_not_matter():
    rng = np.random.default_rng(1)
    batches = [rng.normal(size=(n, 2)) for n in (3, 30, 10)]
    there, back = _seen(*batches), _seen(*batches[::-1])
    np.testing.assert_allclose(there.mean, back.mean, atol=1e-6)
    np.testing.assert_allclose(there.var, back.var, rtol=1e-5)


def test_late_batches_of_a_long_run_still_count():
    """Ten million observations later a batch moves the mean by its share."""
    old = Normalizer(jnp.float32(1e7), jnp.zeros(1), jnp.ones(1))
    new = normalize.update(old, jnp.full((4096, 1), 10.0))
    assert float(new.count) == 1e7 + 4096
    np.testing.assert_allclose(new.mean, 10.0 * 4096 / (1e7 + 4096), rtol=1e-4)


def test_seen_observations_come_out_in_standard_deviations():
    batch = np.random.default_rng(2).normal(3.0, 2.0, size=(1000, 2))
    out = np.asarray(normalize.apply(_seen(batch), jnp.asarray(batch)))
    np.testing.assert_allclose(out.mean(0), 0.0, atol=0.02)
    np.testing.assert_allclose(out.std(0), 1.0, atol=0.02)
    expected = np.clip((batch[0] - batch.mean(0)) / batch.std(0), -5, 5)
    np.testing.assert_allclose(out[0], expected, rtol=1e-3)


def test_nothing_seen_leaves_an_observation_as_it_is():
    obs = jnp.array([[0.5, -2.0]])
    np.testing.assert_array_equal(normalize.apply(normalize.init(2), obs), obs)


def test_outliers_and_constants_stay_finite_and_small():
    state = _seen(np.array([[1.0, 7.0], [3.0, 7.0]]))
    out = normalize.apply(state, jnp.array([[1e9, 7.0], [-1e9, 7.0005], [2.0, 8.0]]))
    np.testing.assert_allclose(out, [[5.0, 0.0], [-5.0, 0.5], [0.0, 5.0]], atol=1e-3)
