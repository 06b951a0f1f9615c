# SPDX-License-Identifier: Apache-2.0
"""Advantages: a table by hand, textbook GAE, and what variable time steps must not change."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills.learn import gae

GAMMA = 0.9


@pytest.fixture(autouse=True)
def exact() -> Iterator[None]:
    """Double precision, and no shape that fits by accident."""
    with jax.enable_x64(True), jax.numpy_rank_promotion("raise"):
        yield


def _rows(**changes: Any) -> dict[str, np.ndarray]:
    """Returns the arguments of `advantages` for four rows of random numbers, some replaced."""
    rng = np.random.default_rng(0)
    rows = {
        "rate": rng.normal(size=4),
        "spike": rng.normal(size=4),
        "dphase": rng.uniform(0.3, 2.0, 4),
        "value": rng.normal(size=4),
        "next_value": rng.normal(size=4),
        "terminated": np.zeros(4, bool),
        "ended": np.zeros(4, bool),
    }
    rows |= {name: np.asarray(value) for name, value in changes.items()}
    return rows


def _chained(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the rows as one episode: each next value is the value of the row after."""
    rows["next_value"] = np.append(rows["value"][1:], rows["next_value"][-1])
    return rows


def _advantages(rows: dict[str, np.ndarray], lambda_: float, gamma: float = GAMMA) -> np.ndarray:
    found = gae.advantages(
        **{k: jnp.asarray(v) for k, v in rows.items()}, gamma=gamma, lambda_=lambda_
    )
    return np.asarray(found)


def _discounted(rate: float, dphase: float, gamma: float = GAMMA) -> float:
    return rate * (gamma**dphase - 1.0) / np.log(gamma)


def test_a_table_by_hand():
    """gamma 1/4, lambda 1/4, spikes: two steps of half a frame, then one whole to a termination.

    row 2: 3 + 0 - 1                       = 2       (terminated: no future)
    row 1: 2 + 1/2 4 - 3 = 1,  + 1/4 * 2   = 1.5     ((1/16)^(1/2) = 1/4)
    row 0: 1 + 1/2 3 - 2 = 0.5, + 1/4 1.5  = 0.875
    """
    rows = _rows(
        rate=[0.0, 0.0, 0.0],
        spike=[1.0, 2.0, 3.0],
        dphase=[0.5, 0.5, 1.0],
        value=[2.0, 3.0, 1.0],
        next_value=[3.0, 4.0, 7.0],
        terminated=[False, False, True],
        ended=[False, False, True],
    )
    np.testing.assert_allclose(_advantages(rows, 0.25, gamma=0.25), [0.875, 1.5, 2.0], rtol=1e-12)


def test_a_rate_is_worth_its_integral():
    for rate, dphase in ((1.0, 1.0), (2.5, 0.3), (-1.0, 4.0), (1.0, 0.0)):
        at = np.linspace(0.0, dphase, 100_001)
        expected = np.trapezoid(rate * 0.95**at, at)
        found = gae.discounted(jnp.float64(rate), jnp.float64(dphase), 0.95)
        np.testing.assert_allclose(float(found), expected, rtol=1e-8, atol=1e-12)


def _textbook(rows: dict[str, np.ndarray], lambda_: float) -> list[float]:
    """Schulman et al. 2016, backwards through the rows, one unit of time each."""
    found, following = [], 0.0
    for t in reversed(range(len(rows["spike"]))):
        goes_on = 0.0 if rows["terminated"][t] else GAMMA
        delta = rows["spike"][t] + goes_on * rows["next_value"][t] - rows["value"][t]
        following = delta + (0.0 if rows["ended"][t] else GAMMA * lambda_ * following)
        found.insert(0, following)
    return found


@pytest.mark.parametrize("lambda_", [0.0, 0.7, 1.0])
def test_spikes_at_unit_steps_are_textbook_gae(lambda_: float):
    rng = np.random.default_rng(1)
    ended = rng.random(40) < 0.2
    rows = {name: rng.normal(size=40) for name in ("spike", "value", "next_value")}
    rows |= {"rate": np.zeros(40), "dphase": np.ones(40), "ended": ended}
    rows["terminated"] = ended & (rng.random(40) < 0.5)
    np.testing.assert_allclose(_advantages(rows, lambda_), _textbook(rows, lambda_), rtol=1e-12)


def test_spikes_at_unit_steps_are_those_of_rlax():
    rlax = pytest.importorskip("rlax")
    rows = _chained(_rows(rate=np.zeros(4), dphase=np.ones(4)))
    values = jnp.asarray(np.append(rows["value"], rows["next_value"][-1]))
    expected = rlax.truncated_generalized_advantage_estimation(
        jnp.asarray(rows["spike"]), jnp.full(4, GAMMA), 0.7, values
    )
    np.testing.assert_allclose(_advantages(rows, 0.7), expected, rtol=1e-9)


def _split(rows: dict[str, np.ndarray], at: int, middle: float) -> dict[str, np.ndarray]:
    """Returns the rows with one cut into two halves in time; `middle` is the value in between.

    A spike is received at the beginning of its row (FS eq. 9), so it stays with the first half.
    """
    halves = {name: np.insert(x, at, x[at]) for name, x in rows.items()}
    halves["dphase"][at : at + 2] /= 2.0
    halves["next_value"][at] = halves["value"][at + 1] = middle
    halves["terminated"][at] = halves["ended"][at] = False
    halves["spike"][at + 1] = 0.0
    return halves


@pytest.mark.parametrize("at", [0, 2, 3])
@pytest.mark.parametrize("final", ["goes on", "terminated", "truncated"])
def test_cutting_a_time_step_in_half_changes_nothing_at_lambda_1(at: int, final: str):
    """FS figure 4: whatever the value function says in between."""
    rows = _chained(_rows())
    rows["ended"][-1] = final != "goes on"
    rows["terminated"][-1] = final == "terminated"
    whole = _advantages(rows, 1.0)
    halves = _advantages(_split(rows, at, middle=-17.0), 1.0)
    np.testing.assert_allclose(np.delete(halves, at + 1), whole, rtol=1e-9)


def test_a_spike_at_the_end_of_a_split_time_step_counts_the_same():
    """Received in the next row, it is discounted by the phase in between, however that is cut."""
    rows = _chained(_rows(spike=[0.0, 0.0, 0.0, 5.0], rate=[1.0, 2.0, 3.0, 0.0]))
    rows["terminated"][-1] = rows["ended"][-1] = True
    whole = _advantages(rows, 1.0)
    split = _split(_split(rows, 2, 3.0), 2, -1.0)
    found = _advantages(split, 1.0)
    np.testing.assert_allclose(np.delete(found, [3, 4]), whole, rtol=1e-9)
    expected = _discounted(3.0, rows["dphase"][2]) + GAMMA ** rows["dphase"][2] * 5.0
    np.testing.assert_allclose(whole[2] + rows["value"][2], expected, rtol=1e-9)


def test_cutting_a_time_step_does_matter_below_lambda_1():
    rows = _chained(_rows())
    apart = _advantages(_split(rows, 1, -17.0), 0.9)[0] - _advantages(rows, 0.9)[0]
    assert abs(apart) > 0.1


def test_returns_do_not_depend_on_how_time_is_warped():
    """The return of a rate over ten frames, in even and in odd time steps."""
    rng = np.random.default_rng(2)
    knots = np.sort(np.concatenate(([0.0, 10.0], rng.uniform(0, 10, 30))))
    returns = []
    for steps in (np.ones(10), np.full(40, 0.25), np.diff(knots), np.array([10.0])):
        count = len(steps)
        rows = {name: np.zeros(count) for name in ("spike", "value", "next_value")}
        rows |= {"rate": np.full(count, 2.0), "dphase": steps}
        rows |= {name: np.arange(count) == count - 1 for name in ("terminated", "ended")}
        returns.append(_advantages(rows, 1.0)[0])
    np.testing.assert_allclose(returns, _discounted(2.0, 10.0), rtol=1e-9)


@pytest.mark.parametrize("terminated", [True, False])
def test_a_cut_trace_is_two_traces(terminated: bool):
    rows = _rows()
    rows["ended"][1], rows["terminated"][1] = True, terminated
    whole = _advantages(rows, 0.8)
    parts = [
        _advantages({name: x[part] for name, x in rows.items()}, 0.8)
        for part in (slice(0, 2), slice(2, 4))
    ]
    np.testing.assert_allclose(whole, np.concatenate(parts), rtol=1e-12)


def test_a_truncated_episode_is_worth_its_future_and_a_terminated_one_is_not():
    rows = _rows(
        rate=[0.0], spike=[1.0], dphase=[2.0], value=[0.5], next_value=[10.0],
        terminated=[False], ended=[True],
    )  # fmt: skip
    np.testing.assert_allclose(_advantages(rows, 0.9), [1.0 + 0.81 * 10.0 - 0.5], rtol=1e-12)
    rows["terminated"][0] = True
    np.testing.assert_allclose(_advantages(rows, 0.9), [1.0 - 0.5], rtol=1e-12)


def test_advantage_and_value_make_the_lambda_return():
    """The mixture of n-step returns, weighted (1 - lambda) lambda^(n-1)."""
    lambda_, rows = 0.6, _chained(_rows(rate=np.zeros(4), dphase=np.ones(4)))
    mixed, n_step, weight = 0.0, 0.0, 1.0
    for n in range(4):
        n_step += GAMMA**n * rows["spike"][n]
        share = (1.0 - lambda_) * weight if n < 3 else weight
        mixed += share * (n_step + GAMMA ** (n + 1) * rows["next_value"][n])
        weight *= lambda_
    found = _advantages(rows, lambda_) + rows["value"]
    np.testing.assert_allclose(found[0], mixed, rtol=1e-12)


def test_a_column_of_numbers_is_refused():
    rows = {name: x[:, None] for name, x in _rows().items()}
    with pytest.raises(AssertionError):
        _advantages(rows, 0.9)
