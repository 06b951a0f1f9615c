# SPDX-License-Identifier: Apache-2.0
"""Traces: what was performed is found again, wherever it was, whatever part of it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import variations

from jaxskills import trace
from jaxskills.character import Character
from jaxskills.motion import Motion
from jaxskills.variation import Variation

KNOTS, ROWS = 16, 60
ROOT, HEADING = slice(0, 6), 5  # displacement indices


@pytest.fixture(scope="module")
def once(who: Character) -> Motion:
    return tiny.make_motion(who, tiny.walking(), loop=False)


@pytest.fixture(scope="module")
def convert(who: Character) -> Callable:
    """(motion, qpos, phase, tau, valid) -> variation, coverage; compiled once a kind of motion."""

    @jax.jit
    def of(motion: Motion, *rows: jax.Array):
        return trace.trace_to_variation(who.layout, motion, *rows, knots=KNOTS)

    return lambda motion, *rows: of(motion, *(jnp.asarray(row, _type(row)) for row in rows))


def _type(row: np.ndarray) -> type:
    return bool if np.asarray(row).dtype == bool else jnp.float32


def _perform(
    who: Character, motion: Motion, variation: Variation, start: float = 0.0, end: float = 31.0
) -> tuple[np.ndarray, ...]:
    """Returns the rows of an episode that performs the variation, unused ones full of nan."""
    qpos, phase, tau = np.full((ROWS, 13), np.nan), np.full(ROWS, np.nan), np.full(ROWS, np.nan)
    at = start
    for row in range(ROWS):
        if at > end:
            break
        qpos[row] = variations.varied_at(who.model, motion, variation, at)
        phase[row], speed = at, variations.speed_at(motion, variation, at)
        tau[row] = np.log(speed)
        at += speed
    return qpos, phase, tau, np.isfinite(phase)


@pytest.mark.parametrize("yaw", [0.0, 2.5])
@pytest.mark.parametrize("seed", [0, 1])
def test_what_was_performed_is_found(
    who: Character, once: Motion, convert: Callable, yaw: float, seed: int
):
    variation = variations.smooth(KNOTS, 11, seed=seed)
    qpos, phase, tau, valid = _perform(who, once, variation)
    assert np.ptp(np.diff(phase[valid])) > 0.3  # time is warped indeed
    qpos[valid] = variations.turned(qpos[valid], yaw, (3.0 * yaw, -yaw))
    found, covered = convert(once, qpos, phase, tau, valid)
    # Rows are a frame apart and knots two: corners at the knots are cut.
    np.testing.assert_allclose(found.d, variation.d, atol=0.02)
    np.testing.assert_allclose(found.tau, variation.tau, atol=0.02)
    np.testing.assert_allclose(covered, 1.0, atol=1e-6)


def test_rows_at_the_knots_are_taken_as_they_are(who: Character, once: Motion, convert: Callable):
    variation = variations.smooth(KNOTS, 11, size=0.8)
    phase = np.linspace(0.0, 30.0, KNOTS)
    qpos = np.stack([variations.varied_at(who.model, once, variation, at) for at in phase])
    pad = lambda x: np.concatenate((x, np.zeros((ROWS - KNOTS, *x.shape[1:]), x.dtype)))  # noqa: E731
    rows = (pad(qpos), pad(phase), pad(np.array(variation.tau)), pad(np.ones(KNOTS, bool)))
    found, _ = convert(once, *rows)
    np.testing.assert_allclose(found.d, variation.d, atol=2e-5)
    np.testing.assert_allclose(found.tau, variation.tau, atol=1e-6)


def test_a_loop_is_told_by_its_first_cycle(who: Character, walk: Motion, convert: Callable):
    wave = np.sin(2.0 * np.pi * np.linspace(0.0, 1.0, KNOTS))
    rows = np.zeros((KNOTS, 11))
    rows[:, 6:] = 0.2 * wave[:, None]
    variation = Variation(jnp.asarray(rows, jnp.float32), jnp.zeros(KNOTS))
    qpos, phase, tau, valid = _perform(who, walk, variation)
    second = _perform(who, walk, variation, end=27.5)[0][:28]
    second[:, 0] += 0.5
    # The row at the end of the first cycle is the first of the second one.
    qpos[30:58], phase[30:58], tau[30:58], valid[30:58] = second, 30.0 + np.arange(28), 0.0, True
    found, covered = convert(walk, qpos, phase, tau, valid)
    np.testing.assert_allclose(found.d, variation.d, atol=0.01)
    assert float(covered) == 1.0


def test_rotations_are_followed_beyond_half_a_turn(who: Character, once: Motion, convert: Callable):
    """A spin that gains 7 rad on the reference, and a joint that goes round the other way."""
    share = np.linspace(0.0, 1.0, KNOTS)
    rows = np.zeros((KNOTS, 11))
    rows[:, HEADING], rows[:, 7] = 7.0 * share, -6.5 * share
    variation = Variation(jnp.asarray(rows, jnp.float32), jnp.zeros(KNOTS))
    found, _ = convert(once, *_perform(who, once, variation))
    np.testing.assert_allclose(found.d, rows, atol=1e-3)


def test_no_episode_is_told_across_a_whole_turn_about_a_changing_axis(
    who: Character, once: Motion, convert: Callable
):
    """A spin of 7 rad that leans 0.05 rad: past 2 pi its rotation vector has to swing round."""
    angle = 7.0 / 30.0 * np.arange(31)
    qpos, phase = np.zeros((ROWS, 13)), np.arange(ROWS, dtype=float)
    for row, turn in enumerate(angle):
        spin = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        qpos[row] = tiny.walking()[row]
        qpos[row, 3:7] = _mul(spin, np.array([np.cos(0.025), 0.0, np.sin(0.025), 0.0]))
    rows = (phase, np.zeros(ROWS))
    found, covered = convert(once, qpos, *rows, phase < 26)
    assert float(covered) == pytest.approx(25 / 30)
    assert float(found.d[12, HEADING]) == pytest.approx(angle[24], abs=0.05)
    assert float(convert(once, qpos, *rows, phase < 31)[1]) == 0.0


def test_turning_round_and_coming_back_to_no_turn(who: Character, once: Motion, convert: Callable):
    """Rows in which a joint stands exactly where the reference does, a whole turn later."""
    angle = np.minimum(np.arange(ROWS) * 0.25 * np.pi, 2.0 * np.pi)
    qpos, phase = tiny.walking(31), np.arange(ROWS, dtype=float)
    qpos = np.concatenate((qpos, np.tile(qpos[-1], (ROWS - 31, 1))))
    turn = np.stack((np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle), 1)
    for row, q in zip(qpos, turn, strict=True):
        row[tiny.SPINE] = _mul(row[tiny.SPINE], q)
    found, _ = convert(once, qpos, phase, np.zeros(ROWS), np.ones(ROWS, bool))
    expected = np.interp(np.linspace(0.0, 30.0, KNOTS), phase, angle)
    np.testing.assert_allclose(found.d[:, 7], expected, atol=1e-3)


def _mul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product = np.zeros(4)
    variations.mujoco.mju_mulQuat(product, a, b)
    return product


@pytest.mark.parametrize(
    ("start", "end", "share"), [(0.0, 31.0, 1.0), (8.0, 31.0, 22 / 30), (0.0, 18.0, 0.6)]
)
def test_an_episode_may_start_late_or_end_early(
    who: Character, once: Motion, convert: Callable, start: float, end: float, share: float
):
    """Against interpolation by numpy, which repeats the nearest row too."""
    rows = np.zeros((KNOTS, 11))
    rows[:, 6:] = np.array(variations.smooth(KNOTS, 5, seed=5).d)
    variation = Variation(jnp.asarray(rows, jnp.float32), jnp.zeros(KNOTS))
    qpos, phase, tau, valid = _perform(who, once, variation, start, end)
    tau[valid] = np.random.default_rng(0).normal(size=valid.sum())
    found, covered = convert(once, qpos, phase, tau, valid)
    references = [variations.reference_at(who.model, once, at) for at in phase[valid]]
    pairs = zip(qpos[valid], references, strict=True)
    d = np.stack([variations.minus(who.model, *pair) for pair in pairs])
    knots = np.linspace(0.0, 30.0, KNOTS)
    for column in range(11):
        expected = np.interp(knots, phase[valid], d[:, column])
        np.testing.assert_allclose(found.d[:, column], expected, atol=2e-5)
    np.testing.assert_allclose(found.tau, np.interp(knots, phase[valid], tau[valid]), atol=1e-5)
    assert float(covered) == pytest.approx(share, abs=1e-5)


def test_gaps_are_bridged_and_broken_rows_left_out(who: Character, once: Motion, convert: Callable):
    variation = variations.smooth(KNOTS, 11, seed=2)
    rows = _perform(who, once, variation)
    whole, _ = convert(once, *rows)
    rows[0][5, 3] = np.nan
    rows[3][9:11] = False
    found, covered = convert(once, *rows)
    assert float(covered) == 1.0
    assert 1e-6 < np.abs(found.d - whole.d).max() < 0.05
    kept = np.array([0, 1, 7, 8, 15])  # knots two frames apart, far from rows 5, 9 and 10
    np.testing.assert_allclose(found.d[kept], whole.d[kept], atol=1e-5)


@pytest.mark.parametrize("nothing", ["no row", "broken rows"])
def test_an_empty_episode_covers_nothing(
    who: Character, once: Motion, convert: Callable, nothing: str
):
    qpos, phase, tau, valid = _perform(who, once, variations.smooth(KNOTS, 11))
    qpos[:] = np.nan
    if nothing == "no row":
        valid[:] = False
    found, covered = convert(once, qpos, phase, tau, valid)
    assert float(covered) == 0.0
    np.testing.assert_array_equal(found.d, 0.0)
    np.testing.assert_array_equal(found.tau, 0.0)


def test_hundreds_at_once(who: Character, once: Motion, convert: Callable):
    episodes = [_perform(who, once, variations.smooth(KNOTS, 11, seed=i)) for i in range(3)]
    batch = [jnp.asarray(np.stack(rows * 100)) for rows in zip(*episodes, strict=True)]
    batch = [x if x.dtype == bool else x.astype(jnp.float32) for x in batch]
    every = jax.jit(
        jax.vmap(lambda *rows: trace.trace_to_variation(who.layout, once, *rows, knots=KNOTS))
    )
    found, covered = every(*batch)
    assert found.d.shape == (300, KNOTS, 11) and covered.shape == (300,)
    for i in (0, 1, 2, 299):
        alone, _ = convert(once, *episodes[i % 3])
        np.testing.assert_allclose(found.d[i], alone.d, atol=1e-5)


def test_poses_are_put_over_the_target(who: Character):
    """The turn is about the vertical, also of someone upside down; height and tilt stay."""
    poses = variations.turned(tiny.walking(), 0.4, (1.0, 2.0))
    for row in poses:  # head over heels, half a turn about y
        row[3:7] = _mul(row[3:7], np.array([0.0, 0.0, 1.0, 0.0]))
    moved = variations.turned(poses, -2.0, (5.0, -7.0))
    moved[:, 2] += 0.1
    found = jax.jit(trace.align)(
        *(jnp.asarray(x, jnp.float32) for x in (moved, moved[4], poses[4]))
    )
    poses[:, 2] += 0.1
    for a, b in zip(np.asarray(found), poses, strict=True):
        np.testing.assert_allclose(variations.minus(who.model, a, b), 0.0, atol=5e-6)
