# SPDX-License-Identifier: Apache-2.0
"""Velocities in flight: what C MuJoCo throws keeps its own, what breaks mechanics gets others."""

import copy
import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import flight, kinematics, motion
from jaxskills.character import Character
from jaxskills.motion import MotionConfig

FRAMES, DT = 25, 1.0 / 60.0
GRAVITY = np.array([0.0, 0.0, -9.81])
PLAIN = MotionConfig(smooth_velocity=0.0)


@pytest.fixture(scope="module")
def thrown(who: Character) -> tuple[np.ndarray, np.ndarray]:
    """`[F, nq]`, `[F, nv]` of the limp walker, which tumbles with swinging legs above the floor."""
    model = copy.copy(who.model)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    model.opt.timestep = DT / 20
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = tiny.standing(1)[0]
    data.qpos[2] = 3.0
    data.qvel[:] = [0.8, 0.3, 2.0, 0.5, -4.0, 0.4, 0.5, 1.0, -0.5, 3.0, -3.0]
    for _ in range(FRAMES):
        rows.append((data.qpos.copy(), data.qvel.copy()))
        for _ in range(20):
            mujoco.mj_step(model, data)
    qpos, qvel = (np.array(column) for column in zip(*rows, strict=True))
    return qpos, qvel


def _motion(who: Character, qpos: np.ndarray) -> motion.Motion:
    times = DT * np.arange(len(qpos))
    return motion.from_qpos(who.model, qpos, times, False, PLAIN)


def test_the_whole_body_is_that_of_kinematics(who: Character, thrown: tuple):
    qpos, qvel = thrown
    tree, params = kinematics.tree(who.model), kinematics.body_params(who.model)
    state = flight.whole_body(who.model, qpos[7], qvel[7])
    seen = kinematics.kinematics(tree, params, jnp.float32(qpos[7]), jnp.float32(qvel[7]))
    linear, angular = kinematics.momentum(params, seen)
    np.testing.assert_allclose(state.center, seen.com, atol=1e-5)
    np.testing.assert_allclose(state.velocity * who.model.body_mass.sum(), linear, atol=1e-3)
    np.testing.assert_allclose(state.angular, angular, atol=1e-4)


def test_the_root_takes_on_any_momentum(who: Character, thrown: tuple):
    qpos, qvel = thrown[0][9], np.array(thrown[1][9])
    velocity, angular = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.7, -0.2])
    state = flight.whole_body(who.model, qpos, qvel)
    qvel[:6] += flight.root_change(state, velocity, angular)
    after = flight.whole_body(who.model, qpos, qvel)
    np.testing.assert_allclose(after.velocity, velocity, atol=1e-9)
    np.testing.assert_allclose(after.angular, angular, atol=1e-9)


def test_a_thrown_body_keeps_its_velocities(who: Character, thrown: tuple):
    made = flight.ballistic(who, _motion(who, thrown[0]))
    inner = slice(1, -1)  # differences are one-sided at the ends
    np.testing.assert_allclose(made.qvel[inner, :6], thrown[1][inner, :6], atol=0.03)


def test_wrong_velocities_are_put_right_and_joints_stay(who: Character, thrown: tuple):
    plain = _motion(who, thrown[0])
    wrong = 0.5 * np.random.default_rng(0).normal(size=(FRAMES, 6))
    wrong -= wrong.mean(0)
    broken = dataclasses.replace(plain, qvel=plain.qvel.at[:, :6].add(jnp.float32(wrong)))
    made = flight.ballistic(who, broken)
    off = np.abs(made.qvel - thrown[1])[1:-1, :6]
    assert off.max() < 0.2 < 1.0 < np.abs(broken.qvel - thrown[1])[:, :6].max()
    np.testing.assert_array_equal(made.qvel[:, 6:], broken.qvel[:, 6:])
    np.testing.assert_array_equal(made.qpos, broken.qpos)
    momenta = [
        flight.whole_body(who.model, q, v).angular
        for q, v in zip(made.qpos, made.qvel, strict=True)
    ]
    assert np.ptp(momenta, axis=0).max() < 1e-3


def test_take_off_leads_up_to_the_flight(who: Character, thrown: tuple):
    """The walker stands before it: turning gathers, and so does what is level, not upwards."""
    ground = np.tile(tiny.standing(1), (20, 1))
    plain = _motion(who, np.concatenate((ground, thrown[0])))
    made = flight.ballistic(who, plain)
    states = [flight.whole_body(who.model, q, v) for q, v in zip(made.qpos, made.qvel, strict=True)]
    wanted, count = states[20].angular, 6  # frames in 0.1 s
    shares = [s.angular[1] / wanted[1] for s in states[20 - count : 20]]
    np.testing.assert_allclose(shares[:-1], np.arange(1, count) / (count + 1), atol=0.02)
    level = [s.velocity[0] / states[20].velocity[0] for s in states[20 - count : 20]]
    np.testing.assert_allclose(level[:-1], np.arange(1, count) / (count + 1), atol=0.02)
    np.testing.assert_allclose([s.velocity[2] for s in states[:19]], 0.0, atol=1e-5)
    np.testing.assert_array_equal(made.qvel[: 20 - count], plain.qvel[: 20 - count])


def test_on_the_floor_nothing_changes(who: Character):
    plain = tiny.make_motion(who, tiny.walking(), loop=True)
    np.testing.assert_array_equal(flight.ballistic(who, plain).qvel, plain.qvel)


def test_flights_are_runs_of_frames_in_the_air():
    lowest = np.array([0.1, 0.1, 0.1, 0.0, 0.3, 0.3, 0.019, 0.03, 0.03, 0.03, 0.03])
    still = np.zeros((11, 3))  # for 1/60 s nobody is thrown by 5 cm
    found = [list(of) for of in flight.flights(lowest, still, DT, GRAVITY)]
    assert found == [[0, 1, 2], [7, 8, 9, 10]]
    assert list(flight.flights(np.zeros(5), still[:5], DT, GRAVITY)) == []


def test_who_pushes_off_with_floating_feet_is_not_thrown_yet():
    """Ten frames in which the centre of mass rises by 20 cm, then twenty of flight."""
    flying = DT * np.arange(20)
    rise = 0.2 * (np.arange(10) / 10) ** 2
    height = np.concatenate((rise, 0.2 + 2.4 * flying - 0.5 * 9.81 * flying**2))
    centers = np.stack((0.0 * height, 0.0 * height, height), 1)
    (found,) = flight.flights(np.full(30, 0.03), centers, DT, GRAVITY)
    assert 5 <= found.start <= 11 and found.stop == 30
    velocity, above = flight.thrown(centers[10:], DT, GRAVITY)
    np.testing.assert_allclose(velocity, [0.0, 0.0, 2.4], atol=1e-9)
    np.testing.assert_allclose(above, 0.0, atol=1e-9)
