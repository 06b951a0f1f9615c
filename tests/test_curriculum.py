# SPDX-License-Identifier: Apache-2.0
"""Curricula: the phases of every method by hand, what they draw, and how they grow a region."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.explore import curriculum, sampling
from jaxskills.explore.curriculum import Curriculum, CurriculumConfig
from jaxskills.explore.sampling import ELSEWHERE, SURROUNDING, VISITED, SamplingConfig

SMALL = SamplingConfig(candidates=512, pool=100, chains=20, thin=3)
BATCH = 4
QUICK = CurriculumConfig(
    batch=BATCH, probes=1, memory=0.0, patience=2, timeout=4, duration=3, mastery=10.0
)
WHERE = jnp.array([0.5, 0.5])
NAMES = "ER"  # exploration, refinement


def _density(elites: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """Of elites `[E, P]` with radius 0.1, FS eq. 15; those beyond 9 are none."""
    return lambda a: jnp.sum(jnp.exp(-jnp.sum((elites - a) ** 2, -1) / 0.01))


def _phases(
    config: CurriculumConfig, script: Sequence[tuple[float, float]], **measured: Sequence[float]
) -> str:
    """Returns the phase after each update, in which a parameter of the surroundings finds the
    first number of `script` and one of the visited region the second."""
    state, phases = curriculum.init(config, WHERE), ""
    region = jnp.array([SURROUNDING, SURROUNDING, VISITED, VISITED])
    update = jit(functools.partial(curriculum.update, config))
    for i, (around, inside) in enumerate(script):
        state = state.replace(**{name: jnp.float32(x[i]) for name, x in measured.items()})
        state = update(state, region, jnp.array([around, around, inside, inside]))
        phases += NAMES[int(state.phase)]
    assert int(state.updates) == len(script)
    return phases


def test_alternating_by_rate():
    script = [
        ((5, 1), "E"),
        ((0, 2), "E"),  # below, once
        ((3, 1), "E"),  # and not again
        ((0, 2), "E"),
        ((0, 1), "R"),  # below, twice in a row
        ((1, 2), "R"),
        ((3, 2), "R"),  # above, once
        ((1, 2), "R"),
        ((3, 2), "R"),
        ((4, 2), "E"),  # above, twice in a row
        ((2, 2), "E"),  # equal is neither
        ((0, 0), "E"),
        ((2, 2), "E"),
    ]
    expected = "".join(phase for _, phase in script)
    assert _phases(QUICK, [rates for rates, _ in script]) == expected


def test_phases_take_turns_while_nothing_is_found():
    """With a memory of 0.5 the rates of the first update are below 0.1 from the fifth on."""
    config = dataclasses.replace(QUICK, memory=0.5, idle=0.1, idle_duration=3)
    nothing = [(0, 0)] * 12
    assert _phases(config, [(1, 0), *nothing]) == "EEEE" + "RRR" + "EEE" + "RRR"
    assert _phases(config, [(1, 0), *nothing[:6], (1, 0), *nothing[:3]]) == "EEEERRRREEE"
    assert _phases(dataclasses.replace(config, idle=0.0), [(1, 0), *nothing]) == "E" * 13


def test_refinement_ends_after_some_updates():
    """It finds more than its probes all along; then exploration does not, twice in a row."""
    config = dataclasses.replace(QUICK, longest=4)
    assert _phases(config, [(1, 2)] * 13) == "E" + "RRRR" + "EE" + "RRRR" + "EE"
    assert _phases(QUICK, [(1, 2)] * 13) == "E" + "R" * 12


def test_nothing_new_is_explored_while_few_get_through():
    """Rates speak for exploration all along."""
    update = jit(functools.partial(curriculum.update, QUICK))
    state, phases = curriculum.init(QUICK, WHERE), ""
    region = jnp.array([SURROUNDING, SURROUNDING, VISITED, VISITED])
    for success in (0.9, 0.4, 0.6, 0.4, 0.4, 0.4, 0.6, 0.4, 0.5, 0.5):
        state = update(state, region, jnp.array([1, 1, 0, 0]), jnp.float32(success))
        phases += NAMES[int(state.phase)]
    assert phases == "EEEE" + "RRRRR" + "E"


def test_rates_are_running_means_per_task_parameter():
    """The first count alike, later ones a fifth; a region without samples keeps its rate."""
    config = dataclasses.replace(QUICK, memory=0.8)
    state = curriculum.init(config, WHERE)
    update = jit(functools.partial(curriculum.update, config))
    table = [  # region, found, rate in the surroundings, rate in the visited region
        ([0, 0, 0, 1], [2, 4, 6, 1], 4.0, 1.0),
        ([0, 0, 1, 1], [1, 3, 0, 1], 3.0, 0.75),
        ([0, 2, 2, 2], [0, 9, 9, 9], 2.0, 0.75),
        ([0, 0, 0, 0], [2, 2, 2, 2], 2.0, 0.75),
        ([0, 0, 0, 1], [7, 7, 7, 3], 3.0, 1.5),
        ([0, 1, 1, 1], [8, 0, 0, 0], 4.0, 1.125),  # now a fifth, and a fourth
    ]
    for region, found, around, inside in table:
        state = update(state, jnp.array(region), jnp.array(found))
        np.testing.assert_allclose(state.rate, [around, inside], rtol=1e-5)
    assert state.seen.tolist() == [6, 4]


@pytest.mark.parametrize(("outlier", "expected"), [(7.7, "EEEEEEEE"), (8.0, "EEEERRRE")])
def test_one_noisy_batch_does_not_change_the_phase(outlier: float, expected: str):
    """Rates 1 and 0 but for the third batch: 0.2 x 0.64 x 7.8 is 1 at the fifth.

    Then the rate drops below 1 again, and at the eighth the change is undone.
    """
    config = CurriculumConfig(batch=BATCH, probes=1)
    state = curriculum.init(config, WHERE)
    state = state.replace(rate=jnp.array([1.0, 0.0]), seen=jnp.array([50, 50]))
    update, phases = jit(functools.partial(curriculum.update, config)), ""
    for i in range(8):
        inside = outlier if i == 2 else 0.0
        state = update(state, jnp.array([0, 0, 0, 1]), jnp.array([1.0, 1.0, 1.0, inside]))
        phases += NAMES[int(state.phase)]
    assert phases == expected


def test_nothing_is_decided_before_both_regions_are_known():
    update = jit(functools.partial(curriculum.update, QUICK))
    state = curriculum.init(QUICK, WHERE)
    for region in ([ELSEWHERE] * 4, [SURROUNDING] * 4):
        for _ in range(4):
            state = update(state, jnp.array(region), jnp.zeros(4))
    assert int(state.phase) == curriculum.EXPLORATION and int(state.streak) == 0


@pytest.mark.parametrize("found", [4, 0])
def test_with_everything_explored_it_refines_for_good(found: int):
    """Also where refinement finds nothing: there is nothing to explore."""
    update = jit(functools.partial(curriculum.update, QUICK))
    state, phases = curriculum.init(QUICK, WHERE), ""
    state = state.replace(rate=jnp.array([5.0, 0.0]), seen=jnp.array([9, 9]))
    for _ in range(5):
        state = update(state, jnp.full(4, VISITED), jnp.array([found, 0, 0, 0]))
        phases += NAMES[int(state.phase)]
    assert phases == "ERRRR"
    assert state.rate.tolist() == [0.0, found / 4]


def test_uniform_has_no_phases():
    script = [(5, 1), (0, 2), (0, 2), (0, 9), (0, 9), (0, 9)]
    config = dataclasses.replace(QUICK, method="uniform")
    assert _phases(config, script, explored=[1.0] * 6, value=[0.0] * 6) == "EEEEEE"


def test_explore_only_refines_once_everything_is_explored():
    """Whatever the rates and values are; and it does not come back."""
    config = dataclasses.replace(QUICK, method="explore_only")
    explored = [0.0, 0.5, 0.9, 0.98, 0.989, 0.991, 0.98, 0.5]
    value = [20.0, 0.0] * 4
    for rates in ((0, 9), (9, 0)):
        phases = _phases(config, [rates] * 8, explored=explored, value=value)
        assert phases == "EEEEERRR"
    assert "R" not in _phases(config, [(0, 9)] * 60, explored=[0.98] * 60)


def test_mastering_refines_until_values_are_high():
    """Mastery is 10, patience 2, time out 4."""
    script = [
        (12, "E"),
        (9, "E"),  # below, once
        (11, "E"),
        (9, "R"),  # four updates are the limit
        (8, "R"),
        (10, "R"),  # mastered, once
        (10, "E"),  # mastered, twice
        (9, "E"),
        (9, "R"),  # below, twice
        (9, "R"),
        (9, "R"),
        (9, "R"),
        (9, "E"),  # timed out
        (20, "E"),
        (20, "E"),
        (20, "E"),
        (20, "R"),  # timed out
    ]
    config = dataclasses.replace(QUICK, method="mastering")
    values = [value for value, _ in script]
    phases = _phases(config, [(0, 9)] * len(script), value=values)
    assert phases == "".join(phase for _, phase in script)


def test_fixed_alternation_counts():
    config = dataclasses.replace(QUICK, method="fixed_alternation")
    for rates in ((0, 9), (9, 0)):
        assert _phases(config, [rates] * 10) == "EERRREEERR"
    long = dataclasses.replace(config, duration=20)
    assert _phases(long, [(1, 1)] * 60) == "E" * 19 + "R" * 20 + "E" * 20 + "R"


def test_a_batch_is_of_its_region():
    """Around two elites; those that probe come last."""
    config = CurriculumConfig(sampling=SMALL)
    density = _density(jnp.array([[0.5, 0.5], [0.6, 0.5]]))
    alone = dataclasses.replace(config, method="explore_only")

    def run(key: jax.Array) -> Any:
        renew_key, draw_key = jax.random.split(key)
        state = curriculum.init(config, WHERE)
        state = curriculum.renew(config, state, density, lambda a: 2.0 + a[..., 0], renew_key)
        refining = state.replace(phase=jnp.int32(curriculum.REFINEMENT))
        pairs = ((config, state), (config, refining), (alone, state), (alone, refining))
        return state, [curriculum.draw(c, x, density, draw_key) for c, x in pairs]

    state, drawn = jit(run)(jax.random.key(0))
    around, inside = SURROUNDING, VISITED
    expected = [
        [around] * 18 + [inside] * 2,
        [inside] * 18 + [around] * 2,
        [around] * 20,
        [inside] * 20,
    ]
    for (a, region), wanted in zip(drawn, expected, strict=True):
        assert a.shape == (20, 2) and region.tolist() == wanted
        np.testing.assert_array_equal(sampling.region(SMALL, jax.vmap(density)(a)), region)
    assert (sampling.region(SMALL, jax.vmap(density)(state.pool)) == VISITED).all()
    # Two discs of radius 0.47 r, and what is between them.
    assert 2 * np.pi * 0.047**2 < float(state.explored) < 0.03
    assert float(state.value) == pytest.approx(2.55, abs=0.02)


def test_uniform_draws_from_all_of_the_space():
    config = CurriculumConfig(method="uniform", batch=400, sampling=SamplingConfig())
    state = curriculum.init(config, WHERE)
    density = _density(jnp.array([[0.5, 0.5]]))
    draw = jit(lambda key: curriculum.draw(config, state, density, key))
    a, region = draw(jax.random.key(0))
    counts = np.histogramdd(np.asarray(a), [np.linspace(0, 1, 4)] * 2)[0]
    assert counts.sum() == 400 and counts.min() > 20
    assert (region == ELSEWHERE).sum() > 300
    np.testing.assert_array_equal(region, sampling.region(config.sampling, jax.vmap(density)(a)))


def test_with_no_elite_it_stays_at_the_reference():
    config = CurriculumConfig(sampling=SMALL)
    state, density = curriculum.init(config, WHERE), _density(jnp.full((3, 2), 10.0))
    draw = jit(lambda state, key: curriculum.draw(config, state, density, key))
    for phase in (0, 1):
        a, region = draw(state.replace(phase=jnp.int32(phase)), jax.random.key(phase))
        np.testing.assert_array_equal(a, np.tile(WHERE, (20, 1)))
        assert region.tolist() == [ELSEWHERE] * 20


CAPACITY = 32
GROW = CurriculumConfig(
    sampling=SamplingConfig(candidates=256, pool=40, chains=20, thin=2), memory=0.5, patience=1
)


def _grow(state: Curriculum, elites: jax.Array, key: jax.Array) -> Any:
    """One update of a character that masters whatever it tries, elites farther apart than 0.08."""
    TRACES.append(1)
    renew_key, draw_key = jax.random.split(jax.random.fold_in(key, state.updates))
    density = _density(elites)
    state = curriculum.renew(GROW, state, density, lambda a: 1.0 + a[..., 0], renew_key)
    a, region = curriculum.draw(GROW, state, density, draw_key)

    def enter(carry: tuple[jax.Array, jax.Array], one: jax.Array) -> Any:
        elites, count = carry
        new = (jnp.abs(elites - one) > 0.08).all()
        return (elites.at[count].set(jnp.where(new, one, elites[count])), count + new), new

    count = jnp.sum(elites[:, 0] < 9.0)
    (grown, _), found = jax.lax.scan(enter, (elites, count), a)
    return curriculum.update(GROW, state, region, found), grown, a, region, found


TRACES: list[int] = []


def test_a_region_grows_from_the_reference_to_the_whole_space():
    start = jnp.full((CAPACITY, 1), 10.0).at[0].set(0.5)
    grow, key = jit(_grow), jax.random.key(3)

    def run() -> tuple[list[Any], list[np.ndarray]]:
        state, elites, steps = curriculum.init(GROW, jnp.array([0.5])), start, []
        for _ in range(20):
            before = np.asarray(elites[:, 0])
            state, elites, a, region, found = grow(state, elites, key)
            steps.append((before, *map(np.asarray, (a[:, 0], region, found)), state))
        return steps, [np.asarray(x) for x in jax.tree.leaves((state, elites))]

    steps, end = run()
    for before, a, region, found, _ in steps:  # from near to far
        nearest = np.abs(a[:, None] - before).min(1)
        assert nearest.max() < 0.2
        assert set(region.tolist()) <= {SURROUNDING, VISITED} and found.max() <= 1
    last = steps[-1][-1]
    assert float(steps[0][-1].explored) == pytest.approx(2 * 0.0472, abs=0.02)
    assert float(last.explored) > 0.99
    assert int(last.phase) == curriculum.REFINEMENT
    assert int(steps[0][-1].phase) == curriculum.EXPLORATION
    pools = [x[-1].pool for x in steps]
    same = [np.array_equal(x, y) for x, y in zip(pools, pools[1:], strict=False)]
    assert [i + 1 for i, kept in enumerate(same) if not kept] == [5, 10, 15]
    _, again = run()
    for x, y in zip(end, again, strict=True):
        np.testing.assert_array_equal(x, y)
    assert len(TRACES) == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"method": "fastest"},
            "unknown curriculum method 'fastest': choose one of alternating_by_rate, uniform,"
            " explore_only, mastering, fixed_alternation",
        ),
        ({"batch": 0}, "curriculum.batch is 0: give 1 or more"),
        ({"batch": 1001}, "curriculum.batch is 1001: give 1 to 1000 (sampling.pool)"),
        ({"renew": 0}, "curriculum.renew is 0: give 1 or more"),
        ({"probes": 0}, "curriculum.probes is 0: give 1 to 19"),
        ({"probes": 20}, "curriculum.probes is 20: give 1 to 19"),
        ({"success": 1.0}, "curriculum.success is 1.0: give 0 <= success < 1"),
        ({"idle": -0.1}, "curriculum.idle is -0.1: give a rate of 0 or more"),
        ({"idle_duration": 0}, "curriculum.idle_duration is 0: give 1 or more"),
        ({"memory": 1.0}, "curriculum.memory is 1.0: give 0 <= memory < 1"),
        ({"patience": 0}, "curriculum.patience is 0: give 1 or more"),
        ({"full": 0.0}, "curriculum.full is 0.0: give 0 < full <= 1"),
        ({"mastery": float("nan")}, "curriculum.mastery is nan: give a finite value"),
        ({"timeout": 0}, "curriculum.timeout is 0: give 1 or more"),
        ({"duration": 0}, "curriculum.duration is 0: give 1 or more"),
        ({"sampling": SamplingConfig(thin=0)}, "sampling.thin is 0: give 1 or more"),
    ],
)
def test_what_is_out_of_range_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError) as raised:
        curriculum.init(CurriculumConfig(**changes), WHERE)
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)


def test_methods_without_probes_need_none():
    curriculum.validate(CurriculumConfig(method="uniform", probes=0))
