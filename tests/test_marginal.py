# SPDX-License-Identifier: Apache-2.0
"""The marginal value: hidden parts average out, units and late values do not matter."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.explore import marginal
from jaxskills.explore.marginal import Marginal, MarginalConfig

SMALL = MarginalConfig(hidden=(64, 64), steps=200)
UPDATE = jit(functools.partial(marginal.update, SMALL))


def _true(a: np.ndarray) -> np.ndarray:
    return 12.0 + 5.0 * np.sin(4.0 * a[..., 0]) - 3.0 * a[..., 1]


def _states(count: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of uneven density, and values that a hidden part of mean 0 changes by up to 6."""
    random = np.random.default_rng(seed)
    a = random.beta(1.0, 1.5, (count, 2)).astype(np.float32)
    hidden = random.uniform(-1.0, 1.0, count)
    return a, (_true(a) + 4.0 * hidden * (0.5 + a[:, 0])).astype(np.float32)


@pytest.fixture(scope="module")
def start() -> Marginal:
    return jit(functools.partial(marginal.init, SMALL, 2))(jax.random.key(0))


def _learnt(start: Marginal, a: np.ndarray, value: np.ndarray, updates: int) -> Marginal:
    state = start
    for i in range(updates):
        state, _ = UPDATE(state, jnp.asarray(a), jnp.asarray(value), jax.random.key(i))
    return state


def test_the_paper_has_two_layers_of_512():
    state = jax.eval_shape(lambda: marginal.init(MarginalConfig(), 3, jax.random.key(0)))
    kernels = sorted(x.shape for x in jax.tree.leaves(state.params) if x.ndim == 2)
    assert kernels == [(3, 512), (512, 1), (512, 512)]
    config = MarginalConfig()
    assert (config.lr, config.minibatch) == (1e-3, 128)


def test_it_learns_the_mean_over_what_it_does_not_see(start: Marginal):
    a, value = _states()
    state = _learnt(start, a, value, 5)
    grid = np.stack(np.meshgrid(np.linspace(0.05, 0.9, 12), np.linspace(0.05, 0.9, 12)), -1)
    wrong = np.asarray(marginal.apply(state, jnp.asarray(grid))) - _true(grid)
    assert wrong.shape == (12, 12)
    assert np.sqrt((wrong**2).mean()) < 0.4  # single values are off by 2.4
    assert abs(wrong.mean()) < 0.25
    assert np.std(_true(grid)) > 2.0


def test_an_untrained_network_says_the_mean_of_what_was_seen(start: Marginal):
    """With the optimiser held still only mean and deviation are learnt."""
    config = MarginalConfig(hidden=(64, 64), steps=1, lr=1e-12)
    a, value = _states()
    update = jit(functools.partial(marginal.update, config))
    state, _ = update(start, jnp.asarray(a), jnp.asarray(value), jax.random.key(0))
    assert float(state.mean) == pytest.approx(value.mean(), rel=1e-5)
    assert float(state.var) == pytest.approx(value.var(), rel=1e-4)
    assert float(marginal.apply(state, jnp.array([0.5, 0.5]))) == pytest.approx(
        value.mean(), abs=0.3
    )


def test_the_unit_of_values_does_not_matter(start: Marginal):
    a, value = _states(500)
    once, moved = _learnt(start, a, value, 1), _learnt(start, a, 100.0 * value - 70.0, 1)
    points = jnp.asarray(a[:50])
    expected = 100.0 * marginal.apply(once, points) - 70.0
    np.testing.assert_allclose(marginal.apply(moved, points), expected, rtol=1e-2)


def test_values_fade_but_the_first_count_alike(start: Marginal):
    """Means 0, 6, 12 of three updates: 6. Then one of 100 moves it by a tenth at the 20th only."""
    config = MarginalConfig(hidden=(64, 64), steps=1)
    update = jit(functools.partial(marginal.update, config))
    a, state = jnp.full((4, 2), 0.5), start
    for i, level in enumerate((0.0, 6.0, 12.0)):
        state, _ = update(state, a, level + jnp.array([-1.0, 1, -1, 1]), jax.random.key(i))
    assert float(state.mean) == pytest.approx(6.0, rel=1e-5)
    assert float(state.var) == pytest.approx(1.0 + 24.0, rel=1e-5)
    old = state.replace(updates=jnp.int32(19))
    new, _ = update(old, a, jnp.full(4, 100.0), jax.random.key(3))
    assert float(new.mean) == pytest.approx(6.0 + 0.1 * 94.0, rel=1e-5)
    assert float(new.var) == pytest.approx(0.9 * 25.0 + 0.09 * 94.0**2, rel=1e-5)


def test_weights_let_every_episode_count_alike(start: Marginal):
    """One episode of 9 states of value 10, one of a single state of value 0, at one parameter."""
    a = jnp.full((10, 2), 0.3)
    value = jnp.array([10.0] * 9 + [0.0])
    for weight, expected in ((None, 9.0), (jnp.array([1 / 9] * 9 + [1.0]), 5.0)):
        state = start
        for i in range(3):
            state, _ = UPDATE(state, a, value, jax.random.key(i), weight)
        assert float(marginal.apply(state, a[0])) == pytest.approx(expected, abs=0.3)


def test_what_is_not_finite_is_left_out(start: Marginal):
    a, value = _states(300)
    bad_a, bad = np.concatenate((a, a[:3])), np.concatenate((value, [np.nan, np.inf, 1.0]))
    bad_a[-1] = np.nan
    found, loss = UPDATE(start, jnp.asarray(bad_a), jnp.asarray(bad), jax.random.key(0))
    assert np.isfinite(loss) and all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert float(found.mean) == pytest.approx(value.mean(), rel=1e-5)
    none = jnp.full(4, jnp.nan)
    same, loss = UPDATE(found, jnp.zeros((4, 2)), none, jax.random.key(1))
    assert (float(same.mean), float(same.var)) == (float(found.mean), float(found.var))
    assert float(loss) == 0.0 and np.isfinite(marginal.apply(same, jnp.asarray(a))).all()


def test_constant_values_are_learnt_as_they_are(start: Marginal):
    a, _ = _states(300)
    state = _learnt(start, a, np.full(300, 7.0, np.float32), 2)
    np.testing.assert_allclose(marginal.apply(state, jnp.asarray(a)), 7.0, atol=1e-2)


def test_same_key_same_bits_and_one_trace(start: Marginal):
    a, value = map(jnp.asarray, _states(200))
    traces = []

    def counted(*args: Any) -> tuple[Marginal, jax.Array]:
        traces.append(1)
        return marginal.update(SMALL, *args)

    update = jit(counted)
    one, other = (
        update(start, a, value, jax.random.key(3)),
        update(start, a, value, jax.random.key(4)),
    )
    again = update(start, a, value, jax.random.key(3))
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(x, y)
    assert float(one[1]) != float(other[1])
    update(one[0], a, value, jax.random.key(5))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hidden": ()}, "marginal.hidden is (): give positive layer sizes, like 512 512"),
        ({"hidden": (8, 0)}, "marginal.hidden is (8, 0): give positive layer sizes"),
        ({"lr": 0.0}, "marginal.lr is 0.0: give a positive number"),
        ({"lr": float("nan")}, "marginal.lr is nan: give a positive number"),
        ({"minibatch": 0}, "marginal.minibatch is 0: give 1 or more"),
        ({"steps": -1}, "marginal.steps is -1: give 1 or more"),
        ({"memory": 1.0}, "marginal.memory is 1.0: give 0 <= memory < 1"),
    ],
)
def test_what_is_out_of_range_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError) as raised:
        marginal.init(MarginalConfig(**changes), 2, jax.random.key(0))
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)
