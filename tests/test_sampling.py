# SPDX-License-Identifier: Apache-2.0
"""Regions by hand; samples against the distributions that they should have."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.explore import sampling
from jaxskills.explore.sampling import ELSEWHERE, SURROUNDING, VISITED, SamplingConfig, Survey

CONFIG = SamplingConfig(candidates=1024, pool=300)
RADIUS = 0.1  # of an elite
# A lone elite: exp(-d^2 / 0.01) is 0.8 and 0.2 at these distances.
INNER, OUTER = RADIUS * np.sqrt(np.log(1 / 0.8)), RADIUS * np.sqrt(np.log(1 / 0.2))

Function = Callable[[jax.Array], jax.Array]

ELITES, WHERE = jnp.array([[0.5, 0.5], [0.6, 0.5]]), jnp.array([0.5, 0.5])
TRACES = []  # of `both`


def _near(elites: Any) -> Function:
    """The density of elites `[E, P]`, FS eq. 15."""
    elites = jnp.asarray(elites, jnp.float32)
    return lambda a: jnp.sum(jnp.exp(-jnp.sum((elites - a) ** 2, -1) / RADIUS**2))


def _everywhere(level: float) -> Function:
    return lambda a: jnp.full((), level) + 0.0 * a[0]


def _many(function: Callable[[jax.Array], Any], count: int, seed: int = 0) -> Any:
    """Results for `count` keys, along a first axis."""
    return jit(jax.vmap(function))(jax.random.split(jax.random.key(seed), count))


def _surrounding(density: Function, reference: jax.Array, count: int, key: jax.Array) -> jax.Array:
    survey_key, draw_key = jax.random.split(key)
    points = sampling.survey(CONFIG, density, reference, survey_key)
    return sampling.surrounding(CONFIG, points, reference, draw_key, count)


def _mcmc(
    density: Function, value: Function, reference: jax.Array, key: jax.Array, config=CONFIG
) -> jax.Array:
    survey_key, walk_key = jax.random.split(key)
    points = sampling.survey(config, density, reference, survey_key)
    return sampling.mcmc(config, density, value, reference, points, walk_key)


@pytest.fixture(scope="module")
def both() -> Callable[..., Any]:
    """(elites, scale of their density, key) -> surroundings `[20, 2]` and pool, around `WHERE`."""

    def draw(elites: jax.Array, scale: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        TRACES.append(1)
        density = lambda a: scale * _near(elites)(a)  # noqa: E731
        pool = _mcmc(density, lambda a: 1.0 + a[..., 0], WHERE, key)
        return _surrounding(density, WHERE, 20, key), pool

    return jit(draw)


@pytest.fixture(scope="module")
def uniform() -> Callable[..., jax.Array]:
    """(level of the density everywhere, keys `[K]`) -> `[K, 5, 1]`."""

    def draw(level: jax.Array, key: jax.Array) -> jax.Array:
        return _surrounding(lambda a: level + 0.0 * a[0], jnp.array([0.1]), 5, key)

    return jit(jax.vmap(draw, in_axes=(None, 0)))


def _agrees(samples: np.ndarray, edges: list[np.ndarray], expected: np.ndarray) -> None:
    """Checks `samples [K, N, P]` of K independent draws against chances of the bins of `edges`.

    Samples of one draw depend on each other, those of different draws do not: their scatter says
    how far the mean may be off.
    """
    count = len(samples)
    shares = np.stack([np.histogramdd(one, edges)[0].ravel() / len(one) for one in samples])
    assert shares.sum(1) == pytest.approx(np.ones(count))  # none outside the bins
    expected = expected.ravel() / expected.sum()
    error = shares.std(0, ddof=1) / np.sqrt(count)
    off = np.abs(shares.mean(0) - expected) / np.maximum(error, 1e-3 / np.sqrt(count))
    assert off.max() < 5.0, off
    assert 0.5 * np.abs(shares.mean(0) - expected).sum() < 0.03  # and that is not far


def test_regions_of_a_lone_elite():
    density = _near([[0.5, 0.5]])
    table = [  # distance, exp(-d^2 / 0.01), region
        (0.0, 1.0, VISITED),
        (0.047, 0.8018, VISITED),
        (0.048, 0.7942, SURROUNDING),
        (0.1, 0.3679, SURROUNDING),
        (0.126, 0.2044, SURROUNDING),
        (0.127, 0.1993, ELSEWHERE),
        (0.4, 0.0, ELSEWHERE),
    ]
    for distance, level, expected in table:
        found = density(jnp.array([0.5 + distance, 0.5]))
        assert float(found) == pytest.approx(level, abs=1e-4)
        assert int(sampling.region(CONFIG, found)) == expected, distance
    limits = jnp.array([0.8, 0.2], jnp.float32)  # a limit itself belongs to the lower region
    assert sampling.region(CONFIG, limits).tolist() == [SURROUNDING, ELSEWHERE]


@pytest.mark.parametrize("reference", [[0.5, 0.5], [0.0, 1.0], [0.1, 0.9]])
def test_a_survey_is_uniform_by_its_weights(reference: list[float]):
    where = jnp.array(reference)
    points = _many(lambda key: sampling.survey(CONFIG, lambda a: a[0], where, key), 30)
    a, weight = np.asarray(points.a), np.asarray(points.weight)
    assert a.min() >= 0.0 and a.max() <= 1.0
    np.testing.assert_allclose(weight.sum(1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(points.density, a[..., 0])
    bins = np.linspace(0, 1, 5)
    shares = np.stack(
        [np.histogramdd(x, [bins, bins], weights=w)[0] for x, w in zip(a, weight, strict=True)]
    )
    error = shares.std(0, ddof=1) / np.sqrt(30)
    assert (np.abs(shares.mean(0) - 1 / 16) < 5 * error).all()
    assert (np.abs(a - where).max(-1) < 1 / 16).mean() > 1 / 8  # the smallest box is well filled


def test_how_much_is_explored_and_worth():
    """A lone elite visits pi d^2 of the space; over it the mean of a linear value is its middle."""
    where = jnp.array([0.4, 0.6])
    density, value = _near([[0.4, 0.6]]), lambda a: 3.0 * a[..., 0] + a[..., 1]

    def measured(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        points = sampling.survey(CONFIG, density, where, key)
        return sampling.explored(CONFIG, points), sampling.mean(CONFIG, points, value, where)

    share, worth = map(np.asarray, _many(measured, 30))
    assert share.mean() == pytest.approx(np.pi * INNER**2, abs=4 * share.std() / np.sqrt(30))
    assert share.std() < 0.1 * share.mean()
    assert worth.mean() == pytest.approx(1.8, abs=0.01)
    a = jnp.array([[0.1, 0.1], [0.6, 0.2], [0.9, 0.9]])
    points = Survey(a, jnp.array([1.0, 0.7, 0.9]), jnp.array([0.2, 0.5, 0.3]))
    assert float(sampling.explored(CONFIG, points)) == pytest.approx(0.5)
    expected = (0.2 * 0.4 + 0.3 * 3.6) / 0.5
    assert float(sampling.mean(CONFIG, points, value, where)) == pytest.approx(expected)
    points = points.replace(density=jnp.zeros(3))
    assert float(sampling.explored(CONFIG, points)) == 0.0
    assert float(sampling.mean(CONFIG, points, value, where)) == pytest.approx(1.8)


def test_surroundings_of_a_lone_elite_are_a_ring():
    """The elite is off the reference; area and angle are uniform over the ring."""
    middle = np.array([0.45, 0.55])
    draw = functools.partial(_surrounding, _near([middle]), jnp.array([0.5, 0.5]), 20)
    a = np.asarray(_many(draw, 40)).reshape(-1, 2) - middle
    distance = np.linalg.norm(a, axis=-1)
    assert INNER - 1e-6 <= distance.min() and distance.max() <= OUTER + 1e-6
    area = (distance**2 - INNER**2) / (OUTER**2 - INNER**2)
    angle = np.arctan2(a[:, 1], a[:, 0]) / (2 * np.pi) + 0.5
    for share in (area, angle):
        assert stats.kstest(share, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("level", [0.5, 2.0])
def test_every_place_of_a_batch_is_a_fair_sample(level: float, uniform: Callable[..., jax.Array]):
    """Of surroundings that are all of the space, and of a space that is explored all over.

    The last of a batch probe on their own, so they may not come from one part of the survey.
    """
    a = np.asarray(uniform(jnp.float32(level), jax.random.split(jax.random.key(0), 300)))
    for place in range(5):
        assert stats.kstest(a[:, place, 0], "uniform").pvalue > 1e-3


def test_a_first_elite_in_a_corner_of_four_dimensions_has_surroundings():
    """They are 1/12000 of the space."""
    corner = jnp.array([0.0, 0.0, 1.0, 1.0])
    a = np.asarray(_many(functools.partial(_surrounding, _near([corner]), corner, 20), 10))
    distance = np.linalg.norm(a - np.asarray(corner), axis=-1)
    assert INNER - 1e-6 <= distance.min() and distance.max() <= OUTER + 1e-6
    assert all(len(np.unique(one, axis=0)) == 20 for one in a)


def test_with_nothing_visited_they_are_the_reference(both: Callable[..., Any]):
    for scale in (0.0, 0.1):  # of the density of two elites, at most 1.4
        batch, pool = both(ELITES, jnp.float32(scale), jax.random.key(0))
        np.testing.assert_array_equal(batch, np.tile(WHERE, (20, 1)))
        np.testing.assert_array_equal(pool, np.tile(WHERE, (300, 1)))
    batch, pool = both(ELITES, jnp.float32(0.5), jax.random.key(0))
    assert len(np.unique(batch, axis=0)) == 20 and len(np.unique(pool, axis=0)) == 1


def test_same_key_same_bits_and_one_trace(both: Callable[..., Any]):
    one, again, other = (both(ELITES, jnp.float32(1), jax.random.key(k)) for k in (1, 1, 2))
    both(ELITES.at[1].set(0.2), jnp.float32(1), jax.random.key(1))
    for x, y, z in zip(one, again, other, strict=True):
        np.testing.assert_array_equal(x, y)
        assert not np.array_equal(x, z)
    assert len(TRACES) == 1


def test_none_but_members_are_chosen():
    """Whatever the rounding of sums: weights from 1e-9 to 1, members at either end or not."""
    random, size = np.random.default_rng(0), 1000
    rows = jnp.arange(size, dtype=jnp.float32)[:, None]
    draw = jit(lambda *args: sampling._chosen(*args, count=400))
    for trial in range(30):
        member = random.uniform(size=size) < (0.002, 0.5)[trial % 2]
        member[[0, 17, -1]] = trial % 3 == 0, True, trial % 5 == 0
        weight = jnp.asarray(10.0 ** random.uniform(-9, 0, size), jnp.float32)
        points = Survey(rows, jnp.zeros(size), weight)
        found = draw(points, jnp.asarray(member), weight, -jnp.ones(1), jax.random.key(trial))
        assert member[np.asarray(found[:, 0]).astype(int)].all()


@pytest.mark.parametrize("limit", [1e6, 3.0, 1.0])
def test_mcmc_of_one_parameter(limit: float):
    """V = 1 + a up to 0.7, where the region ends: p = exp(-10 (a - 0.35) / 1.35), limited."""
    inside = lambda a: jnp.where(a[0] < 0.7, 1.0, 0.0)  # noqa: E731
    value = lambda a: 1.0 + a[..., 0]  # noqa: E731
    config = dataclasses.replace(CONFIG, limit=limit)
    draw = functools.partial(_mcmc, inside, value, jnp.array([0.2]), config=config)
    pool = np.asarray(_many(draw, 40))
    assert pool.shape == (40, 300, 1)
    assert pool.min() >= 0.0 and pool.max() < 0.7
    fine = (np.arange(7000) + 0.5) * 1e-4
    p = np.clip(np.exp(-10.0 * (fine - 0.35) / 1.35), 1.0 / limit, limit)
    _agrees(pool, [np.linspace(0.0, 0.7, 8)], p.reshape(7, 1000).sum(1))


def _islands(a: Any, module: Any) -> Any:
    """Two discs of radius 0.2, one of them cut by a face of the box."""
    first = module.sum((a - module.array([0.25, 0.1])) ** 2, -1) < 0.04
    second = module.sum((a - module.array([0.75, 0.75])) ** 2, -1) < 0.04
    return first | second


def _worth(a: Any) -> Any:
    return 2.0 + 0.4 * (a[..., 0] > 0.5) + 0.8 * a[..., 1]


def test_mcmc_of_two_islands():
    """No chain crosses the gap: their shares are those of the starting points."""
    density = lambda a: jnp.where(_islands(a, jnp), 1.0, 0.0)  # noqa: E731
    config = dataclasses.replace(CONFIG, limit=1e6)
    draw = functools.partial(_mcmc, density, _worth, jnp.array([0.3, 0.2]), config=config)
    pool = np.asarray(_many(draw, 40))
    assert _islands(pool, np).all() and pool.min() >= 0.0
    fine = (np.arange(1000) + 0.5) / 1000
    grid = np.stack(np.meshgrid(fine, fine, indexing="ij"), -1)
    inside, worth = _islands(grid, np), _worth(grid)
    mu = worth[inside].mean()
    p = np.where(inside, np.exp(-10.0 * (worth - mu) / mu), 0.0)
    expected = p.reshape(5, 200, 5, 200).sum((1, 3))
    edges = np.linspace(0.0, 1.0, 6)
    _agrees(pool, [edges, edges], expected)


def test_chains_find_the_distribution_from_anywhere():
    """All begin where p is lowest: Metropolis' rule alone brings them to exp(-6 a), reflected."""
    config = SamplingConfig(chains=50, thin=5, pool=3000)
    log_p = lambda a: jnp.where(a[..., 0] < 0.9, -6.0 * a[..., 0], -jnp.inf)  # noqa: E731
    start = jnp.full((50, 1), 0.89)
    pool = np.asarray(_many(lambda key: sampling._walk(config, log_p, start, key), 30))
    edges = np.linspace(0.0, 0.9, 7)
    _agrees(pool[:, 1000:], [edges], -np.diff(np.exp(-6.0 * edges)))


def test_low_values_are_preferred_whatever_their_sign():
    """The mean of 1 + a is 1.5: shifted below, to and far below 0."""

    def draw(shift: jax.Array, key: jax.Array) -> jax.Array:
        return _mcmc(_everywhere(1.0), lambda a: 1.0 + a[..., 0] + shift, jnp.array([0.5]), key)

    shifts = jnp.array([-2.5, -1.5, -10.0])
    pools = np.asarray(jit(jax.vmap(draw))(shifts, jax.random.split(jax.random.key(0), 3)))
    for pool in pools:
        assert np.isfinite(pool).all() and len(np.unique(pool)) > 100
        assert pool.mean() < 0.45


def test_reflection():
    a = jnp.array([-0.25, 0.0, 0.4, 1.0, 1.2, 2.1, -1.3])
    expected = [0.25, 0.0, 0.4, 1.0, 0.8, 0.1, 0.7]
    np.testing.assert_allclose(sampling.reflected(a), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"visited": 0.1}, "sampling.surrounding, visited are 0.2, 0.1: give 0 <= surrounding <"),
        ({"surrounding": -0.1}, "sampling.surrounding, visited are -0.1, 0.8: give 0 <="),
        ({"visited": float("nan")}, "sampling.surrounding, visited are 0.2, nan: give 0 <="),
        ({"candidates": 7}, "sampling.candidates is 7: give 8 to 1000000"),
        ({"preference": -1.0}, "sampling.preference is -1.0: give 0 to 1000"),
        ({"limit": 0.9}, "sampling.limit is 0.9: give a factor of 1 or more"),
        ({"pool": 0}, "sampling.pool is 0: give 1 or more"),
        ({"chains": 0}, "sampling.chains is 0: give 1 or more"),
        ({"thin": 0}, "sampling.thin is 0: give 1 or more"),
        ({"step": 0.0}, "sampling.step is 0.0: give 0 < step <= 1"),
    ],
)
def test_what_is_out_of_range_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError) as raised:
        sampling.validate(SamplingConfig(**changes))
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)
