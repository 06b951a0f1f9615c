# SPDX-License-Identifier: Apache-2.0
"""Varied motions: FS eq. 1 to 3 against MuJoCo, velocities, loops, time warps, figure 4."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import variations
from scipy.spatial.transform import Rotation

from jaxskills import motion as motion_lib
from jaxskills import variation as lib
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.learn import gae
from jaxskills.motion import CONTROL_DT, Motion, MotionConfig
from jaxskills.variation import Variation, VariationConfig

KNOTS, NV = 16, 11
PLAIN = MotionConfig(smooth_velocity=0.0)


@pytest.fixture(scope="module")
def once(who: Character) -> Motion:
    """The walk, performed once, with the velocities of its poses."""
    return motion_lib.from_qpos(who.model, tiny.walking(), np.linspace(0, 1, 31), False, PLAIN)


@pytest.fixture(scope="module")
def circle(who: Character) -> Motion:
    """A loop that turns by 0.8 rad."""
    angle = 0.8 * np.linspace(0.0, 1.0, 31)
    qpos = variations.turned(tiny.walking(), 0.0, (0.0, 0.0))
    qpos[:, 0], qpos[:, 1] = np.sin(angle) / 0.8, (1.0 - np.cos(angle)) / 0.8
    qpos[:, 3], qpos[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
    config = MotionConfig(turn_with_cycle=True)
    return motion_lib.from_qpos(who.model, qpos, np.linspace(0, 1, 31), True, config)


def _displace(who: Character, motion: Motion, variation: Variation) -> Motion:
    return jax.jit(lib.displace, static_argnums=0)(who.layout, motion, variation)


@pytest.mark.parametrize("kind", ["walk", "once", "circle"])
@pytest.mark.parametrize("knots", [16, 40])
def test_no_variation_is_the_reference(
    who: Character, kind: str, knots: int, request: pytest.FixtureRequest
):
    motion = request.getfixturevalue(kind)
    same = _displace(who, motion, lib.zeros(knots, NV))
    np.testing.assert_array_equal(same.qpos, motion.qpos)
    np.testing.assert_allclose(same.qvel, motion.qvel, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(same.cycle_pos, motion.cycle_pos)
    assert float(lib.duration(motion, lib.zeros(knots, NV))) == pytest.approx(1.0, rel=1e-6)


def test_poses_are_those_of_mujoco(who: Character, once: Motion):
    variation = variations.smooth(KNOTS, NV, size=1.0)
    found = _displace(who, once, variation)
    expected = [variations.varied_at(who.model, once, variation, phase) for phase in range(31)]
    np.testing.assert_allclose(found.qpos, np.stack(expected), atol=2e-6)
    assert np.abs(found.qpos - once.qpos).max() > 0.3


def test_velocities_are_the_rates_of_the_poses_in_time(who: Character, once: Motion):
    """Differences over two frames of phase, which are exact for what turns evenly."""
    variation = variations.smooth(KNOTS, NV, size=1.0)
    found = _displace(who, once, variation)
    poses = [variations.varied_at(who.model, once, variation, phase) for phase in range(31)]
    for i in range(1, 30):
        change = variations.minus(who.model, poses[i + 1], poses[i - 1]) / (2.0 * CONTROL_DT)
        expected = variations.speed_at(once, variation, i) * change
        # Turns about changing axes differ by their curvature within a frame.
        np.testing.assert_allclose(found.qvel[i, :3], expected[:3], atol=1e-4)
        np.testing.assert_allclose(found.qvel[i, 9:], expected[9:], atol=1e-4)
        np.testing.assert_allclose(found.qvel[i], expected, atol=0.05)
    assert np.abs(found.qvel - once.qvel).max() > 1.0


def test_a_steady_displacement_turns_velocities_into_its_frame(who: Character, once: Motion):
    """q exp(d) turns as q does: in its own frame that is the same vector, turned back by d."""
    turn = np.array([0.5, -0.8, 0.3])
    d = jnp.zeros((KNOTS, NV)).at[:, 6:9].set(turn)
    found = _displace(who, once, Variation(d, jnp.full(KNOTS, np.log(2.0))))
    expected = 2.0 * np.array(once.qvel)
    expected[:, 6:9] = Rotation.from_rotvec(turn).inv().apply(expected[:, 6:9])
    np.testing.assert_allclose(found.qvel, expected, atol=1e-5)
    assert np.abs(expected[:, 6:9] - 2.0 * np.array(once.qvel)[:, 6:9]).max() > 0.1


def test_a_rising_displacement_is_a_speed_also_at_the_ends(who: Character, once: Motion):
    slope = np.linspace(-1.0, 1.0, NV) * [1, 1, 1, 0, 0, 0, 0, 0, 0, 1, 1]
    d = jnp.asarray(np.linspace(0.0, 1.0, KNOTS)[:, None] * slope, jnp.float32)
    found = _displace(who, once, Variation(d, jnp.zeros(KNOTS)))
    np.testing.assert_allclose(found.qvel, np.array(once.qvel) + slope, atol=2e-5)


@pytest.mark.parametrize("kind", ["walk", "circle"])
def test_a_varied_loop_goes_on_where_it_has_led_to(
    who: Character, kind: str, request: pytest.FixtureRequest
):
    """Its poses are those asked for, up to its end, and its next cycle is its first one, moved.

    Asked for at the end: 0.3 m further, 0.25 m higher, and 2.5 rad more of a turn.
    """
    motion = request.getfixturevalue(kind)
    rows = np.linspace(0.0, 1.0, KNOTS)[:, None] * np.array([0.3, 0, 0.25, 0, 0, 2.5] + [0.0] * 5)
    variation = Variation(jnp.asarray(rows, jnp.float32), jnp.zeros(KNOTS))
    varied = _displace(who, motion, variation)
    for phase in (0, 13, 30):
        expected = variations.varied_at(who.model, motion, variation, phase)
        np.testing.assert_allclose(varied.qpos[phase], expected, atol=2e-6)
    step = 1e-3
    seam = float(motion.length) + np.array([-step, step, 6.0])
    sampled = jax.vmap(lambda p: motion_lib.sample(who.layout, varied, p)[0])
    before, after, later = np.asarray(sampled(jnp.asarray(seam, jnp.float32)))
    assert np.abs(variations.minus(who.model, before, after)[:6]).max() < 2e-3
    angle = float(motion.cycle_yaw) + 2.5
    turn = Rotation.from_euler("z", angle)
    own, first = np.asarray(varied.qpos[6]), np.asarray(varied.qpos[0])
    moved = np.asarray(varied.qpos[-1])[:3] + turn.apply(own[:3] - first[:3])
    np.testing.assert_allclose(later[:3], moved, atol=1e-4)
    found = Rotation.from_quat(later[3:7], scalar_first=True)
    expected = turn * Rotation.from_quat(own[3:7], scalar_first=True)
    assert (found * expected.inv()).magnitude() < 1e-3
    assert float(varied.cycle_pos[2]) == pytest.approx(0.25, abs=1e-5)


def test_a_joint_that_ends_elsewhere_stays_as_asked(who: Character, walk: Motion):
    """A hip that is 0.4 rad off at the end alone, and not at the beginning."""
    d = jnp.zeros((KNOTS + 1, NV)).at[-1, 9].set(0.4)
    varied = _displace(who, walk, Variation(d, jnp.zeros(KNOTS + 1)))
    change = np.asarray(varied.qpos - walk.qpos)[:, tiny.LEFT_HIP]
    np.testing.assert_allclose(change[[0, 15, 30]], [0.0, 0.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(varied.cycle_pos, walk.cycle_pos, atol=1e-6)


def test_many_stack(who: Character, once: Motion):
    rows = [variations.smooth(KNOTS, NV, seed=i) for i in range(20)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *rows)
    every = jax.jit(jax.vmap(lambda one: lib.displace(who.layout, once, one)))(stacked)
    assert every.qpos.shape == (20, 31, 13) and every.length.shape == (20,)
    for i in (0, 7, 19):
        alone = _displace(who, once, rows[i])
        np.testing.assert_allclose(every.qpos[i], alone.qpos, atol=1e-6)
        np.testing.assert_allclose(every.qvel[i], alone.qvel, atol=1e-4)


def test_flat_variations_list_knot_by_knot():
    variation = variations.smooth(KNOTS, NV)
    x = lib.flatten(variation)
    assert x.shape == (KNOTS * (NV + 1),)
    np.testing.assert_array_equal(x[NV + 1 : 2 * NV + 1], variation.d[1])
    assert float(x[2 * NV + 1]) == float(variation.tau[1])
    for shape in ((), (3,), (2, 3)):
        many = jax.tree.map(lambda y: jnp.broadcast_to(y, (*shape, *y.shape)), variation)  # noqa: B023
        back = lib.unflatten(lib.flatten(many), NV)
        np.testing.assert_array_equal(back.d, many.d)
        np.testing.assert_array_equal(back.tau, many.tau)


def test_a_warp_by_hand():
    """Steps 1, 2, 1/2 and 1: phases 0, 1, 3, 3.5, 4.5 at control steps 0 to 4."""
    phases = lib.warp(jnp.log(jnp.array([1.0, 2.0, 0.5, 1.0])))
    np.testing.assert_allclose(phases, [0.0, 1.0, 3.0, 3.5, 4.5], rtol=1e-6)
    steps = jnp.array([0.0, 0.5, 1.25, 2.5, 4.0])
    expected = [0.0, 0.5, 1.5, 3.25, 4.5]
    np.testing.assert_allclose(lib.phase_at(phases, steps * CONTROL_DT), expected, rtol=1e-6)
    seconds = lib.seconds_at(phases, jnp.array(expected))
    np.testing.assert_allclose(seconds, steps * CONTROL_DT, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0, 1000.0, np.inf])
def test_time_never_stalls_nor_turns_back(size: float):
    for seed in range(5):
        tau = np.random.default_rng(seed).normal(size=90) * size
        phases = np.asarray(lib.warp(jnp.asarray(tau, jnp.float32)))
        assert np.isfinite(phases).all() and (np.diff(phases) > 0.0).all()
        middle = np.linspace(0.0, 89.0, 300, dtype=np.float32) * CONTROL_DT
        there = lib.phase_at(jnp.asarray(phases), jnp.asarray(middle))
        back = lib.seconds_at(jnp.asarray(phases), there)
        np.testing.assert_allclose(back, middle, atol=5e-3)


def test_rates_are_linear_in_tau_and_go_on(walk: Motion, once: Motion):
    wave = np.sin(2.0 * np.pi * np.linspace(0.0, 1.0, KNOTS)).astype(np.float32)
    variation = Variation(jnp.zeros((KNOTS, NV)), jnp.asarray(wave + 0.5))
    at = np.array([0.0, 1.0, 7.3, 22.0, 30.0])
    expected = [variations.speed_at(once, variation, phase) for phase in at]
    phases = jnp.asarray(at, jnp.float32)
    np.testing.assert_allclose(lib.rate(once, variation, phases), expected, rtol=1e-5)
    np.testing.assert_allclose(lib.rate(walk, variation, phases + 60.0), expected, rtol=1e-4)
    ends = lib.rate(once, variation, jnp.array([-5.0, 45.0]))
    np.testing.assert_allclose(ends, [expected[0], expected[-1]], rtol=1e-5)


@pytest.mark.parametrize("speed", [0.02, 1.0])
def test_duration_is_the_time_it_takes(once: Motion, speed: float):
    variation = variations.smooth(KNOTS, NV, seed=3, speed=speed)
    at = np.linspace(0.0, 30.0, 30_001)
    slow = [1.0 / variations.speed_at(once, variation, phase) for phase in at]
    expected = np.trapezoid(slow, at) * CONTROL_DT
    found = float(lib.duration(once, variation))
    assert found == pytest.approx(expected, rel=1e-5)
    assert abs(expected - 1.0) > 0.1 * speed
    # Performed in control steps, it takes as long to within one.
    phase, steps = 0.0, 0
    while phase < 30.0:
        phase, steps = phase + variations.speed_at(once, variation, phase), steps + 1
    assert abs(steps * CONTROL_DT - found) < CONTROL_DT


def test_returns_do_not_depend_on_the_steps_they_are_received_in():
    """FS figure 4: a rate that changes at phase 3, and a spike at phase 3 and one at 6.

    Once in steps of 1, once in random ones that meet the marks too.
    """
    gamma, rates, spikes = 0.8, (1.0, -0.5), {3.0: 2.0, 6.0: 1.0}
    random = np.random.default_rng(0).uniform(0.2, 1.8, (2, 7))
    sequences = [np.log(np.ones(6)), np.log((3.0 * random / random.sum(1, keepdims=True)).ravel())]
    with jax.enable_x64(True):
        returns = []
        for tau in sequences:
            phases = np.asarray(lib.warp(jnp.asarray(tau)))
            np.testing.assert_allclose(phases[-1], 6.0, rtol=1e-12)
            worth = sum(gamma**phase * spike for phase, spike in spikes.items())
            for start, step in zip(phases[:-1], np.diff(phases), strict=True):
                rate = jnp.float64(rates[int(start > 3.0 - 1e-9)])
                worth += gamma**start * float(gae.discounted(rate, jnp.float64(step), gamma))
            returns.append(worth)
    whole = (gamma**3 - 1.0) / np.log(gamma)
    exact = whole - 0.5 * gamma**3 * whole + 2.0 * gamma**3 + gamma**6
    np.testing.assert_allclose(returns, exact, rtol=1e-12)


def test_how_many_knots(once: Motion):
    assert lib.knot_count(VariationConfig(), once) == 16  # a second: 30 control frames
    assert lib.knot_count(VariationConfig(knot_every=1.0), once) == 31
    assert lib.knot_count(VariationConfig(knot_every=10.0), once) == 16
    assert lib.knot_count(VariationConfig(knot_every=10.0, fewest_knots=2), once) == 4


def test_out_of_range():
    lib.validate(VariationConfig())
    for value in (0.0, float("nan"), 1e3):
        with pytest.raises(UserError, match="variation.knot_every is"):
            lib.validate(VariationConfig(knot_every=value))
    with pytest.raises(UserError, match="variation.fewest_knots is 1"):
        lib.validate(VariationConfig(fewest_knots=1))
