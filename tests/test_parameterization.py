# SPDX-License-Identifier: Apache-2.0
"""The network from task parameters to motions: learns a known map, its loss, when it is trusted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.errors import UserError
from jaxskills.explore import elites as elites_lib
from jaxskills.explore import parameterization
from jaxskills.explore.elites import Elites
from jaxskills.explore.parameterization import Parameterization, ParameterizationConfig

SIZE = 12
SMALL = ParameterizationConfig(hidden=(64, 64), lr=3e-3, steps=100)

_init = jax.jit(parameterization.init, static_argnums=(0, 1, 2))
_update = jax.jit(parameterization.update, static_argnums=0)
_draw = jax.jit(parameterization.draw, static_argnums=0)
_apply = jax.jit(parameterization.apply)
_proxy = jax.jit(elites_lib.proxy, static_argnums=2)


def _motions(a: np.ndarray) -> np.ndarray:
    """A smooth map `[..., 2]` -> `[..., 12]`; entries differ in scale 100 times, all off zero."""
    bend = np.arange(1, SIZE + 1) / 4
    waves = np.sin(bend * a[..., :1] + 1) + np.cos(bend * a[..., 1:]) * a[..., :1] + bend
    return waves * np.geomspace(0.01, 1.0, SIZE)


@pytest.fixture(scope="module")
def elites() -> Elites:
    """150 elites in every second of 300 rows; what the other rows hold would spoil everything."""
    a = np.random.default_rng(0).uniform(size=(300, 2))
    used = np.arange(300) % 2 == 1
    x = np.where(used[:, None], _motions(a), 1e3)
    fitness = np.where(used, 0.5 + 0.4 * a[:, 0], 9.0)
    return Elites(*(jnp.asarray(part, jnp.float32) for part in (a, x, fitness)), jnp.asarray(used))


@pytest.fixture(scope="module")
def fresh() -> Parameterization:
    return _init(SMALL, 2, SIZE, jax.random.key(0))


@pytest.fixture(scope="module")
def trained(fresh: Parameterization, elites: Elites) -> Parameterization:
    for i in range(15):
        fresh = _update(SMALL, fresh, elites, jax.random.key(i))
    return fresh


def _same(one: object, other: object) -> bool:
    return jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), one, other))


def test_learns_a_smooth_map(trained: Parameterization):
    """Where no elite lies, errors are a few percent of what motions differ by."""
    a = np.random.default_rng(1).uniform(0.05, 0.95, (500, 2)).astype(np.float32)
    wrong = np.asarray(_apply(trained, jnp.asarray(a))) - _motions(a)
    share = np.sqrt(np.mean(wrong**2, axis=0)) / np.std(_motions(a), axis=0)
    assert share.max() < 0.05  # of every entry, large or small
    assert np.sum(np.mean(wrong**2, axis=0)) < 0.01


def test_shapes(trained: Parameterization):
    a = jnp.zeros((4, 3, 2))
    assert _apply(trained, a).shape == (4, 3, SIZE)
    np.testing.assert_allclose(_apply(trained, a)[1, 2], _apply(trained, a[0, 0]), rtol=1e-5)


def test_a_network_begins_at_the_mean_and_its_loss_is_the_variance(
    fresh: Parameterization, elites: Elites
):
    """FS eq. 12 in its own units: the sum over entries of the mean squared error."""
    config = dataclasses.replace(SMALL, steps=1, minibatch=20_000, memory=0.0, lr=1e-9)
    state = _update(config, fresh, elites, jax.random.key(0))
    x = np.asarray(elites.x)[np.asarray(elites.used)]
    np.testing.assert_allclose(state.mean, x.mean(0), rtol=1e-5)
    np.testing.assert_allclose(state.scale, x.std(0), rtol=1e-4)
    assert float(state.loss) == pytest.approx(x.var(0).sum(), rel=0.05)
    # And of this network: it has not moved, and every elite is drawn about as often as another.
    wrong = np.asarray(_apply(state, elites.a[elites.used])) - x
    assert float(state.loss) == pytest.approx((wrong**2).sum(1).mean(), rel=0.02)


def test_the_loss_is_a_running_average(fresh: Parameterization, elites: Elites):
    """With memory 0.75: a quarter of the new loss and three of the old; the first as it is."""
    config = dataclasses.replace(SMALL, steps=1, memory=0.0)
    slow = dataclasses.replace(config, memory=0.75)
    first, second = jax.random.split(jax.random.key(0))
    assert np.isinf(fresh.loss)
    one = _update(slow, fresh, elites, first)
    alone = _update(config, fresh, elites, first)
    assert float(one.loss) == pytest.approx(float(alone.loss))
    two = _update(slow, one, elites, second)
    new = _update(config, one, elites, second)
    assert float(two.loss) == pytest.approx(0.75 * float(one.loss) + 0.25 * float(new.loss))


def test_without_elites_nothing_changes(trained: Parameterization, elites: Elites):
    none = elites.replace(used=jnp.zeros(300, bool))
    assert _same(_update(SMALL, trained, none, jax.random.key(0)), trained)


def test_one_elite_is_learnt_and_stays_finite(fresh: Parameterization, elites: Elites):
    lone = elites.replace(used=jnp.arange(300) == 7)
    state = _update(SMALL, fresh, lone, jax.random.key(0))
    found = _apply(state, elites.a[7])
    np.testing.assert_allclose(found, elites.x[7], atol=1e-4)
    assert np.isfinite(state.loss)


def test_same_key_same_bits(fresh: Parameterization, elites: Elites):
    one, again, other = (_update(SMALL, fresh, elites, jax.random.key(i)) for i in (0, 0, 1))
    assert _same(one, again)
    assert not _same(one.params, other.params)
    begin = _init(SMALL, 2, SIZE, jax.random.key(0))
    assert _same(begin, fresh)


def test_traced_once(fresh: Parameterization, elites: Elites):
    config, traced = dataclasses.replace(SMALL, steps=2), []

    def step(state: Parameterization, elites: Elites, key: jax.Array):
        traced.append(1)
        state = parameterization.update(config, state, elites, key)
        return state, parameterization.draw(config, state, elites, elites.a[:5], key)

    run, state = jax.jit(step), fresh
    for i in range(3):
        state, _ = run(state, elites.replace(used=jnp.arange(300) % 2 == i % 2), jax.random.key(i))
    assert len(traced) == 1


def test_draws_are_the_proxy_until_the_loss_is_low(trained: Parameterization, elites: Elites):
    a = elites.a[:50] * 0.9
    level = SMALL.threshold**2 * SIZE
    proxy = _proxy(elites, a)
    for loss in (np.inf, level * 1.01):
        state = trained.replace(loss=jnp.float32(loss))
        assert not parameterization.trusted(SMALL, state)
        drawn = _draw(SMALL, state, elites, a, jax.random.key(0))
        np.testing.assert_allclose(drawn, proxy, rtol=1e-6)
    assert parameterization.trusted(SMALL, trained.replace(loss=jnp.float32(level * 0.99)))
    never = dataclasses.replace(SMALL, threshold=0.0)
    assert not parameterization.trusted(never, trained.replace(loss=jnp.float32(0.0)))


def test_draws_are_either_with_equal_chance_after(trained: Parameterization, elites: Elites):
    assert parameterization.trusted(SMALL, trained)
    a = jnp.tile(jnp.array([[0.9, 0.1]]), (4000, 1))
    drawn = np.asarray(_draw(SMALL, trained, elites, a, jax.random.key(3)))
    network = np.asarray(_apply(trained, a[0]))
    proxy = np.asarray(_proxy(elites, a[0], SMALL.neighbours, SMALL.sigma))
    assert np.abs(network - proxy).max() > 1e-3
    of_network = np.isclose(drawn, network, rtol=1e-4, atol=1e-5).all(1)
    of_proxy = np.isclose(drawn, proxy, rtol=1e-4, atol=1e-5).all(1)
    assert (of_network ^ of_proxy).all()
    assert of_network.mean() == pytest.approx(0.5, abs=0.03)


def test_the_proxy_drawn_is_that_of_the_configuration(fresh: Parameterization, elites: Elites):
    config = dataclasses.replace(SMALL, neighbours=2, sigma=0.05)
    a = jnp.array([[0.4, 0.4]])
    drawn = _draw(config, fresh, elites, a, jax.random.key(0))
    np.testing.assert_allclose(drawn, _proxy(elites, a, 2, 0.05), rtol=1e-6)
    assert not np.allclose(drawn, _proxy(elites, a), rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("hidden", (), "is (): give positive layer sizes, like 512 512"),
        ("hidden", (512, 0), "is (512, 0): give positive layer sizes, like 512 512"),
        ("minibatch", 0, "is 0: give 1 to 1000000"),
        ("steps", 0, "is 0: give 1 to 1000000"),
        ("neighbours", 0, "is 0: give 1 to 1000000"),
        ("lr", 0.0, "is 0.0: give a positive number"),
        ("sigma", float("nan"), "is nan: give a positive number"),
        ("memory", 1.0, "is 1.0: give 0 <= memory < 1"),
        ("threshold", -1.0, "is -1.0: give 0 (never the network) or more"),
    ],
)
def test_what_is_out_of_range_is_refused(name: str, value: object, message: str):
    parameterization.validate(ParameterizationConfig())
    with pytest.raises(UserError) as raised:
        parameterization.validate(dataclasses.replace(ParameterizationConfig(), **{name: value}))
    assert str(raised.value) == f"parameterization.{name} {message}"
