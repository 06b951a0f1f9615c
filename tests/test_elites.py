# SPDX-License-Identifier: Apache-2.0
"""Elite episodes: who enters, against a plain loop; density and proxy by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.errors import UserError
from jaxskills.explore import elites as elites_lib
from jaxskills.explore.elites import EliteConfig, Elites, Episodes

SMALL = EliteConfig(capacity=8)

_insert = jax.jit(elites_lib.insert, static_argnums=0)
_density = jax.jit(elites_lib.density, static_argnums=0)
_explored_ratio = jax.jit(elites_lib.explored_ratio, static_argnums=(0, 3))
_proxy = jax.jit(elites_lib.proxy, static_argnums=2)


def _episodes(a: np.ndarray, fitness: np.ndarray, valid: np.ndarray | None = None) -> Episodes:
    """Episodes whose motion tells which one they are: x = (fitness, a...)."""
    a, fitness = np.asarray(a, np.float32), np.asarray(fitness, np.float32)
    x = np.concatenate((fitness[:, None], a), axis=1)
    valid = np.ones(len(a), bool) if valid is None else valid
    a, x, fitness, valid = map(jnp.asarray, (a, x, fitness, valid))
    return Episodes(a, x, fitness, likeness=fitness, valid=valid)


def _line(*pairs: tuple[float, float]) -> Episodes:
    """Episodes of one task parameter, each (a, fitness)."""
    return _episodes(np.array([[a] for a, _ in pairs]), np.array([f for _, f in pairs]))


def _after(config: EliteConfig, found: Elites, *pairs: tuple[float, float]):
    """`insert` of a few (a, fitness); padded, so that it is compiled once for any number."""
    new = _line(*pairs, *[(0.5, 9.0)] * (3 - len(pairs)))
    new = new.replace(valid=jnp.arange(3) < len(pairs))
    found, entered, counted = _insert(config, found, new)
    return found, entered[: len(pairs)].tolist(), counted[: len(pairs)].tolist()


def _holding(config: EliteConfig, *pairs: tuple[float, float]) -> Elites:
    found, entered, _ = _after(config, elites_lib.init(config, 1, 2), *pairs)
    assert all(entered)
    return found


def _scattered(count: int, parameters: int) -> Elites:
    """Elites anywhere, in about half of the rows; what the other rows hold would spoil results."""
    random = np.random.default_rng(count)
    a, fitness = random.uniform(size=(count, parameters)), random.uniform(0.1, 1.0, count)
    used = random.uniform(size=count) < 0.5
    new = _episodes(a, np.where(used, fitness, 99.0))
    return Elites(new.a, new.x, new.fitness, jnp.asarray(used))


def _members(found: Elites) -> set[tuple[float, ...]]:
    """The elites as (fitness, a...); their motions have to be their own."""
    used = np.asarray(found.used)
    a, x, fitness = (np.asarray(part)[used] for part in (found.a, found.x, found.fitness))
    own = np.concatenate((fitness[:, None], a), axis=1)
    np.testing.assert_array_equal(x, own)
    return {tuple(map(float, row)) for row in own}


def _by_loop(config: EliteConfig, members: list[tuple[float, ...]], episodes: Episodes):
    """The rule of FS 5.2, one episode after the other, on a list of (fitness, a...)."""
    entered, counted = [], []
    arrays = (np.asarray(part) for part in (episodes.a, episodes.fitness, episodes.valid))
    for a, fitness, valid in zip(*arrays, strict=True):
        new = (float(fitness), *map(float, a))
        near = [m for m in members if np.sum(np.subtract(m[1:], new[1:]) ** 2) < config.radius**2]
        if not near and len(members) == config.capacity:
            near = [min(members)]
        able = bool(valid) and all(-config.radius <= x <= 1.0 + config.radius for x in new[1:])
        wins = able and new[0] > config.threshold and all(new[0] > m[0] for m in near)
        entered.append(wins)
        counted.append(wins and all(new[0] - m[0] >= config.margin for m in near))
        if wins:
            members = [m for m in members if m not in near] + [new]
    return members, entered, counted


@pytest.mark.parametrize(
    ("parameters", "capacity", "radius", "overflows"),
    [(1, 50, 0.1, False), (2, 30, 0.1, True), (3, 12, 0.3, True), (4, 400, 0.2, False)],
)
def test_many_episodes_as_by_a_plain_loop(
    parameters: int, capacity: int, radius: float, overflows: bool
):
    config = EliteConfig(capacity=capacity, radius=radius)
    random = np.random.default_rng(parameters)
    found, members = elites_lib.init(config, parameters, parameters + 1), []
    sizes, entries, counts = [], 0, 0
    for _ in range(5):
        a = random.uniform(-0.15, 1.15, (120, parameters))
        new = _episodes(a, random.uniform(0.0, 1.0, 120), random.uniform(size=120) < 0.9)
        found, entered, counted = _insert(config, found, new)
        members, expected, expected_counted = _by_loop(config, members, new)
        np.testing.assert_array_equal(entered, expected)
        np.testing.assert_array_equal(counted, expected_counted)
        assert _members(found) == set(members)
        place = np.array([m[1:] for m in members])
        between = np.linalg.norm(place[:, None] - place, axis=-1) + np.eye(len(place))
        assert between.min() >= radius - 1e-6
        sizes.append(len(members))
        entries, counts = entries + sum(expected), counts + sum(expected_counted)
    assert (capacity in sizes) == overflows
    assert sizes[-1] < counts < entries < 600  # some replace, of these some by little


def test_one_that_beats_all_neighbours_replaces_them_and_their_rows_are_free_again():
    config = EliteConfig(capacity=3)
    found = _holding(config, (0.40, 0.3), (0.52, 0.5), (0.9, 0.2))
    found, entered, counted = _after(config, found, (0.46, 0.6))
    assert entered == counted == [True]
    assert int(found.used.sum()) == 2
    found, entered, _ = _after(config, found, (0.1, 0.15), (0.7, 0.11))
    assert entered == [True, False]  # the second finds it full, and is the least fit
    assert {round(m[1], 2) for m in _members(found)} == {0.46, 0.9, 0.1}


def test_one_that_beats_only_some_neighbours_is_dismissed():
    found = _holding(SMALL, (0.40, 0.3), (0.52, 0.5))
    after, entered, counted = _after(SMALL, found, (0.46, 0.4), (0.46, 0.5))
    assert entered == counted == [False, False]
    assert _members(after) == _members(found)


def test_at_the_radius_is_outside():
    config = EliteConfig(capacity=8, radius=0.25)
    found = _holding(config, (0.25, 0.5))
    after, entered, _ = _after(config, found, (0.5, 0.4), (0.0, 0.4))
    assert entered == [True, True]
    assert int(after.used.sum()) == 3


def test_failed_episodes_stay_out():
    empty = elites_lib.init(SMALL, 1, 2)
    found, entered, counted = _after(SMALL, empty, (0.2, 0.1), (0.8, 0.11))
    assert entered == counted == [False, True]
    assert int(found.used.sum()) == 1


def test_who_failed_stays_out_also_with_a_constraint_kept():
    episodes = _line((0.2, 0.15), (0.8, 0.25)).replace(likeness=jnp.array([0.05, 0.15]))
    _, entered, _ = _insert(SMALL, elites_lib.init(SMALL, 1, 2), episodes)
    assert entered.tolist() == [False, True]


def test_who_is_far_outside_of_the_task_space_stays_out():
    a = np.array([[-0.2, 0.5], [0.5, 1.2], [0.5, 1.05], [-0.05, 0.5]])
    _, entered, _ = _insert(SMALL, elites_lib.init(SMALL, 2, 3), _episodes(a, np.full(4, 0.5)))
    np.testing.assert_array_equal(entered, [False, False, True, True])


def test_better_by_less_than_the_margin_does_not_count():
    found = _holding(SMALL, (0.5, 0.5), (0.62, 0.59))
    _, entered, counted = _after(SMALL, found, (0.45, 0.519))
    assert (entered, counted) == ([True], [False])
    _, entered, counted = _after(SMALL, found, (0.45, 0.521))
    assert (entered, counted) == ([True], [True])
    # Of two that go, the better one has to be beaten by the margin.
    _, entered, counted = _after(SMALL, found, (0.56, 0.6))
    assert (entered, counted) == ([True], [False])


def test_the_least_fit_of_a_full_set_counts_as_replaced():
    config = EliteConfig(capacity=2)
    found = _holding(config, (0.2, 0.5), (0.8, 0.3))
    after, entered, counted = _after(config, found, (0.5, 0.31))
    assert (entered, counted) == ([True], [False])
    assert {round(m[0], 2) for m in _members(after)} == {0.5, 0.31}
    _, entered, counted = _after(config, found, (0.5, 0.4))
    assert (entered, counted) == ([True], [True])


def test_order_matters():
    """0.4 replaces 0.3 and then falls to 0.5, whose distance to 0.3 is more than the radius."""
    pairs = (0.30, 0.3), (0.38, 0.4), (0.46, 0.5)
    empty = elites_lib.init(SMALL, 1, 2)
    up, up_entered, _ = _after(SMALL, empty, *pairs)
    down, down_entered, _ = _after(SMALL, empty, *pairs[::-1])
    assert up_entered == [True, True, True]
    assert down_entered == [True, False, True]
    assert {round(m[1], 2) for m in _members(up)} == {0.46}
    assert {round(m[1], 2) for m in _members(down)} == {0.30, 0.46}


def test_episodes_that_are_masked_or_not_finite_are_ignored():
    new = _line((0.1, 0.5), (0.3, 0.5), (0.5, 0.5), (0.7, 0.5), (0.9, 0.5))
    new = new.replace(
        a=new.a.at[1, 0].set(jnp.nan),
        x=new.x.at[2, 1].set(jnp.inf),
        fitness=new.fitness.at[3].set(jnp.inf),
        valid=new.valid.at[4].set(False),
    )
    found, entered, counted = _insert(SMALL, elites_lib.init(SMALL, 1, 2), new)
    assert entered.tolist() == counted.tolist() == [True, False, False, False, False]
    assert len(_members(found)) == 1
    assert np.isfinite(found.a).all() and np.isfinite(found.x).all()


def test_inserting_is_traced_once_and_writes_in_place():
    config, traced = EliteConfig(capacity=2000), []

    def insert(elites: Elites, new: Episodes):
        traced.append(1)
        return elites_lib.insert(config, elites, new)

    random = np.random.default_rng(0)
    found = elites_lib.init(config, 2, 500)
    inserting = jax.jit(insert, donate_argnums=0)
    for _ in range(3):
        new = _episodes(random.uniform(size=(20, 2)), random.uniform(size=20))
        new = new.replace(x=jnp.zeros((20, 500)))
        memory = inserting.lower(found, new).compile().memory_analysis()
        found, *_ = inserting(found, new)
    assert len(traced) <= 2  # `lower` and the call may trace one each, never again
    assert memory.alias_size_in_bytes >= found.x.nbytes
    assert memory.temp_size_in_bytes < found.x.nbytes / 10


def test_density_of_a_lone_elite():
    found = _holding(SMALL, (0.5, 0.5))
    a = 0.5 + jnp.array([[0.0], [0.0520], [-0.1396], [0.11], [0.5]])
    density = _density(SMALL, found, a)
    np.testing.assert_allclose(density, [1.0, 0.8, 0.2, np.exp(-1.0), 0.0], atol=1e-3)


@pytest.mark.parametrize("parameters", [1, 2, 3, 4])
def test_density_as_by_a_plain_loop(parameters: int):
    config = EliteConfig(capacity=40, radius=0.2)
    found, random = _scattered(40, parameters), np.random.default_rng(1)
    places = random.uniform(size=(3, 5, parameters)).astype(np.float32)
    members = np.array(list(_members(found)))[:, 1:]
    expected = [
        [sum(np.exp(-np.sum((m - a) ** 2) / 0.22**2) for m in members) for a in row]
        for row in places
    ]
    np.testing.assert_allclose(_density(config, found, places), expected, rtol=1e-4)


def test_explored_ratio():
    """One elite at 0.5 makes 2 x 0.0520 of the line dense; a fine grid makes all of it."""
    empty = elites_lib.init(SMALL, 1, 2)
    assert float(_explored_ratio(SMALL, empty)) == 0.0
    one = _holding(SMALL, (0.5, 0.5))
    assert float(_explored_ratio(SMALL, one)) == pytest.approx(0.1039, abs=2e-3)
    assert float(_explored_ratio(SMALL, one, 0.2)) == pytest.approx(0.2791, abs=2e-3)
    grid = np.stack(np.meshgrid(*[np.arange(11) * 0.101] * 2), -1).reshape(-1, 2)
    new = _episodes(grid, np.full(len(grid), 0.5))
    full = Elites(new.a, new.x, new.fitness, new.valid)
    assert float(_explored_ratio(SMALL, full)) == 1.0


@pytest.mark.parametrize(("apart", "dense", "fits"), [(0.199, 1, 0), (0.209, 1, 1), (0.23, 0, 1)])
def test_what_is_not_dense_between_two_elites_has_room_for_a_third(
    apart: float, dense: bool, fits: bool
):
    """Or else a line could never be explored completely. The third is fit enough to enter."""
    pair = _holding(SMALL, (0.4, 0.5), (0.4 + apart, 0.5))
    middle = np.array([[0.4 + apart / 2]])
    assert bool(_density(SMALL, pair, middle)[0] > 0.8) == dense
    _, entered, _ = elites_lib.insert(SMALL, pair, _episodes(middle, np.array([0.3])))
    assert bool(entered[0]) == fits


@pytest.mark.parametrize("parameters", [1, 2, 3, 4])
def test_points_are_spread_evenly(parameters: int):
    """In each of many boxes there are as many points as its volume says."""
    points = elites_lib.spread(1024, parameters)
    assert points.shape == (1024, parameters)
    assert 0.0 <= points.min() and points.max() < 1.0
    random = np.random.default_rng(0)
    for _ in range(50):
        low, high = np.sort(random.uniform(size=(2, parameters)), axis=0)
        share = np.mean(np.all((points > low) & (points < high), axis=1))
        assert share == pytest.approx(np.prod(high - low), abs=0.015)


def test_mean_of_three_elites_by_hand():
    """Weights F exp(-d^2 / 0.0784) at 0.3, of elites at distances 0.1, 0.2 and 0.5."""
    found = _holding(SMALL, (0.2, 0.4), (0.5, 0.8), (0.8, 1.0))
    weights = np.array([0.4 * 0.88024, 0.8 * 0.60036, 1.0 * 0.04123])
    weights /= weights.sum()
    expected = [weights @ [0.4, 0.8, 1.0], weights @ [0.2, 0.5, 0.8]]
    found = _proxy(found, jnp.array([0.3]), 5, ridge=100.0)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_proxy_as_by_a_plain_loop():
    """Weighted least squares with a ridge, solved as one stacked system."""
    found, random = _scattered(60, 2), np.random.default_rng(2)
    places = random.uniform(size=(4, 3, 2)).astype(np.float32)
    members = np.array(list(_members(found)))

    def one(a: np.ndarray, k: int, ridge: float) -> np.ndarray:
        squared = np.sum((members[:, 1:] - a) ** 2, axis=1)
        nearest = np.argsort(squared)[:k]
        near = members[nearest]
        weights = near[:, 0] * np.exp(-squared[nearest] / 0.28**2)
        weights /= weights.sum()
        middle, mean = weights @ near[:, 1:], weights @ near
        left = np.sqrt(weights)[:, None] * (near[:, 1:] - middle)
        right = np.sqrt(weights)[:, None] * (near - mean)
        left = np.concatenate((left, ridge * np.eye(2)))
        right = np.concatenate((right, np.zeros((2, right.shape[1]))))
        slope = np.linalg.lstsq(left, right)[0]
        ahead = a - middle
        return mean + ahead * min(1.0, 0.28 / np.linalg.norm(ahead)) @ slope

    for k, ridge in ((1, 0.03), (5, 0.03), (5, 0.3), (8, 100.0)):
        expected = [[one(a, k, ridge) for a in row] for row in places]
        got = _proxy(found, places, k, ridge=ridge)
        np.testing.assert_allclose(got, expected, rtol=2e-4, atol=1e-5)


def test_proxy_goes_on_as_the_elites_change():
    """Motions that are linear in the task: also at the rim, where a mean would lie inside."""
    a = np.stack(np.meshgrid([0.3, 0.4, 0.5], [0.4, 0.5]), -1).reshape(-1, 2)
    new = _episodes(a, np.full(len(a), 0.5))
    x = 2.0 * a[:, :1] - 3.0 * a[:, 1:] + [[0.0, 1.0]]
    linear = Elites(new.a, jnp.asarray(x, jnp.float32), new.fitness, new.valid)
    beyond = jnp.array([[0.6, 0.45], [0.4, 0.45]])
    wanted = 2.0 * beyond[:, :1] - 3.0 * beyond[:, 1:] + jnp.array([[0.0, 1.0]])
    np.testing.assert_allclose(_proxy(linear, beyond, 6, ridge=1e-3), wanted, atol=2e-3)
    mean = _proxy(linear, beyond, 6, ridge=100.0)
    assert abs(mean[0, 0] - wanted[0, 0]) > 0.1 > 10 * abs(mean[1, 0] - wanted[1, 0])


def test_proxy_at_an_elite_whose_neighbours_are_far():
    config = EliteConfig(capacity=8)
    found = _holding(config, (0.0, 0.5), (1.0, 0.6))
    np.testing.assert_allclose(_proxy(found, jnp.array([0.0])), [0.5, 0.0], atol=1e-5)
    # Far from all, where every weight by itself would vanish, the nearest still decides.
    np.testing.assert_allclose(_proxy(found, jnp.array([9.0])), [0.6, 1.0], atol=1e-5)


def test_proxy_with_few_elites_and_with_none():
    a = jnp.array([[0.1], [0.9]])
    assert not _proxy(elites_lib.init(SMALL, 1, 2), a).any()
    lone = _holding(SMALL, (0.5, 0.75))
    np.testing.assert_allclose(_proxy(lone, a), [[0.75, 0.5]] * 2, rtol=1e-6)
    tiny = EliteConfig(capacity=2)  # fewer rows than neighbours
    np.testing.assert_allclose(_proxy(_holding(tiny, (0.5, 0.75)), a), [[0.75, 0.5]] * 2, rtol=1e-6)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EliteConfig(capacity=0), "elites.capacity is 0: give 1 to 1000000"),
        (EliteConfig(radius=0.0), "elites.radius is 0.0: give a number in (0, 10]"),
        (EliteConfig(threshold=-0.1), "elites.threshold is -0.1: give 0 or more"),
        (EliteConfig(margin=float("nan")), "elites.margin is nan: give 0 or more"),
    ],
)
def test_what_is_out_of_range_is_refused(config: EliteConfig, message: str):
    elites_lib.validate(EliteConfig())
    with pytest.raises(UserError) as raised:
        elites_lib.validate(config)
    assert str(raised.value) == message
