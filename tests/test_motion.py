# SPDX-License-Identifier: Apache-2.0
"""Reference motions: the seam of a loop, cycles, the end of a motion, resampling, velocities."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import motion, pose
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.motion import CONTROL_DT, Motion, MotionConfig

PLAIN = MotionConfig(smooth_velocity=0.0)
TURNING = MotionConfig(turn_with_cycle=True)


def _times(qpos: np.ndarray, seconds: float = 1.0) -> np.ndarray:
    return np.linspace(0.0, seconds, len(qpos))


def _sampler(who: Character, made: Motion) -> Callable:
    """Returns (phases) -> poses and velocities, compiled once."""
    batched = jax.jit(jax.vmap(lambda phase: motion.sample(who.layout, made, phase)))
    return lambda phases: tuple(
        np.asarray(x) for x in batched(jnp.asarray(np.atleast_1d(phases), jnp.float32))
    )


def _drifting(frames: int = 31) -> np.ndarray:
    """Returns a walk that ends elsewhere than it began: a gap in height, heading, spine and hip."""
    qpos, share = tiny.walking(frames), np.linspace(0.0, 1.0, frames)
    qpos[:, 2] += 0.04 * share
    qpos[:, 3:7] = np.stack((np.cos(0.1 * share), 0 * share, 0 * share, np.sin(0.1 * share)), 1)
    qpos[:, tiny.LEFT_HIP] += 0.1 * share
    return qpos


def _circling(frames: int = 31, turn: float = 0.8, speed: float = 1.0) -> np.ndarray:
    """Returns a walk on a circle at even speed (m/s) that turns by `turn` in its one second."""
    angle = turn * np.linspace(0.0, 1.0, frames)
    qpos = tiny.walking(frames)
    qpos[:, 0], qpos[:, 1] = speed / turn * np.sin(angle), speed / turn * (1.0 - np.cos(angle))
    qpos[:, 3], qpos[:, 6] = np.cos(angle / 2), np.sin(angle / 2)
    return qpos


def _distance(who: Character, a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(pose.minus(who.layout, jnp.asarray(a), jnp.asarray(b))).max())


@pytest.mark.parametrize(
    ("poses", "config"),
    [(_drifting(), MotionConfig()), (_drifting(), TURNING), (_circling(), TURNING)],
    ids=["gap", "gap while turning", "circle"],
)
@pytest.mark.parametrize("cycle", [1, 3])
def test_the_seam_is_continuous_in_pose_and_velocity(
    who: Character, poses: np.ndarray, config: MotionConfig, cycle: int
):
    made = motion.from_qpos(who.model, poses, _times(poses), True, config)
    seam = cycle * float(made.length)
    qpos, qvel = _sampler(who, made)(seam + np.array([-2e-3, 2e-3]))
    # 4e-3 control frames apart, a metre and a few radians a second.
    assert _distance(who, qpos[0], qpos[1]) < 1e-3
    np.testing.assert_allclose(qvel[0], qvel[1], rtol=0, atol=0.02)


def test_a_loop_without_a_gap_is_left_as_it_is(who: Character):
    poses = tiny.walking()
    made = motion.from_qpos(who.model, poses, _times(poses), True)
    np.testing.assert_allclose(made.qpos, poses, rtol=0, atol=1e-6)
    np.testing.assert_allclose(made.cycle_pos, [0.5, 0.0, 0.0], atol=1e-6)


def test_only_the_neighbourhood_of_the_seam_is_bent_to_close_it(who: Character):
    poses = _drifting(61)
    made = motion.from_qpos(who.model, poses, _times(poses, 2.0), True)
    far = slice(5, 56)  # 0.15 s are 4.5 frames
    np.testing.assert_allclose(np.asarray(made.qpos)[far], poses[far], rtol=0, atol=1e-6)
    assert _distance(who, np.asarray(made.qpos)[0], poses[0].astype(np.float32)) > 0.01
    # Both ends give way alike.
    first, last = np.asarray(made.qpos)[[0, -1], 2]
    np.testing.assert_allclose([first, last], [0.52, 0.52], atol=1e-6)


def test_each_cycle_adds_its_displacement(who: Character):
    made = tiny.make_motion(who, tiny.walking(), True)
    length = float(made.length)
    (first, later), (v_first, v_later) = _sampler(who, made)([7.3, 7.3 + 4 * length])
    np.testing.assert_allclose(later[:3] - first[:3], [4 * 0.5, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(later[3:], first[3:], atol=1e-5)
    np.testing.assert_allclose(v_later, v_first, atol=1e-4)


def test_before_the_first_cycle_lies_the_one_before_it(who: Character):
    made = tiny.make_motion(who, tiny.walking(), True)
    (first, before), _ = _sampler(who, made)([7.3, 7.3 - float(made.length)])
    np.testing.assert_allclose(before[:3] - first[:3], [-0.5, 0.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("turn", [0.8, -0.3, 1e-8])
def test_turning_cycles_are_the_repeated_turn_and_step(who: Character, turn: float):
    poses = _circling(turn=turn)
    made = motion.from_qpos(who.model, poses, _times(poses), True, TURNING)
    yaw, step = float(made.cycle_yaw), np.asarray(made.cycle_pos, float)
    np.testing.assert_allclose(yaw, turn, atol=1e-6)
    matrix = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    phase = 11.4
    cycles = np.arange(6)
    qpos, qvel = _sampler(who, made)(phase + cycles * float(made.length))
    place, speed = qpos[0, :3].astype(float), qvel[0, :3].astype(float)
    for cycle in cycles:
        np.testing.assert_allclose(qpos[cycle, :3], place, atol=3e-5)
        np.testing.assert_allclose(qvel[cycle, :3], speed, atol=1e-4)
        heading = 2.0 * np.arctan2(qpos[cycle, 6], qpos[cycle, 3])
        at_first = 2.0 * np.arctan2(qpos[0, 6], qpos[0, 3])
        apart = np.remainder(heading - at_first - cycle * yaw + np.pi, 2 * np.pi) - np.pi
        np.testing.assert_allclose(apart, 0.0, atol=1e-5)
        np.testing.assert_allclose(qpos[cycle, 7:], qpos[0, 7:], atol=1e-5)
        np.testing.assert_allclose(qvel[cycle, 3:], qvel[0, 3:], atol=1e-4)
        place, speed = matrix @ place + step, matrix @ speed


def test_a_circle_is_walked_on_at_even_speed(who: Character):
    poses = _circling()
    made = motion.from_qpos(who.model, poses, _times(poses), True, TURNING)
    qpos, qvel = _sampler(who, made)(np.linspace(0.0, 2.5 * float(made.length), 200))
    radius = np.hypot(qpos[:, 0], qpos[:, 1] - 1.0 / 0.8)
    np.testing.assert_allclose(radius, 1.0 / 0.8, atol=1e-3)
    np.testing.assert_allclose(np.hypot(qvel[:, 0], qvel[:, 1]), 1.0, atol=5e-3)
    # The velocity points where the walker faces.
    facing = 2.0 * np.arctan2(qpos[:, 6], qpos[:, 3])
    along = qvel[:, 0] * np.cos(facing) + qvel[:, 1] * np.sin(facing)
    np.testing.assert_allclose(along, 1.0, atol=5e-3)


def test_without_turning_the_heading_of_a_cycle_is_undone(who: Character):
    poses = _circling()
    made = motion.from_qpos(who.model, poses, _times(poses), True)
    assert float(made.cycle_yaw) == 0.0
    qpos, _ = _sampler(who, made)([3.0, 3.0 + 5 * float(made.length)])
    np.testing.assert_allclose(qpos[1, 3:7], qpos[0, 3:7], atol=1e-5)


def test_a_motion_without_loop_stays_at_its_last_pose_at_rest(who: Character):
    poses = _drifting()
    made = tiny.make_motion(who, poses, loop=False)
    length = float(made.length)
    qpos, qvel = _sampler(who, made)([length, length + 0.5, 10 * length])
    np.testing.assert_allclose(qpos, np.tile(poses[-1], (3, 1)), atol=1e-6)
    np.testing.assert_array_equal(qvel, np.zeros((3, who.layout.nv)))
    qpos, qvel = _sampler(who, made)([length - 1e-3, -5.0])
    assert np.abs(qvel[0]).max() > 0.1
    np.testing.assert_allclose(qpos[1], poses[0], atol=1e-6)


@pytest.mark.parametrize("loop", [True, False])
def test_frames_are_met_exactly(who: Character, loop: bool):
    poses = _drifting(17)
    made = motion.from_qpos(who.model, poses, _times(poses, 0.5), loop)
    assert made.qpos.shape == (17, 13)  # finer than control frames: kept
    phases = np.arange(16) * (float(made.length) / 16)
    qpos, qvel = _sampler(who, made)(phases + 1e-5)
    np.testing.assert_allclose(qpos, np.asarray(made.qpos)[:-1], atol=2e-5)
    np.testing.assert_allclose(qvel, np.asarray(made.qvel)[:-1], atol=2e-3)
    if not loop:
        np.testing.assert_allclose(made.qpos, poses, atol=1e-6)


def test_a_coarse_clip_gets_a_pose_for_every_control_frame(who: Character):
    poses = tiny.walking(5)
    made = tiny.make_motion(who, poses, True, seconds=2.0)
    assert made.qpos.shape == (61, 13)
    assert float(made.length) == pytest.approx(60.0)
    assert made.seconds == pytest.approx(2.0)


def test_unequal_time_steps_are_resampled(who: Character):
    """Points of one straight and evenly turning motion at odd times give back that motion."""
    rng = np.random.default_rng(0)
    times = np.sort(np.concatenate(([0.0, 1.3], rng.uniform(0.0, 1.3, 40))))
    start = tiny.standing(1)[0]
    rate = np.array([0.7, -0.2, 0.1, 0.3, 0.2, 0.9, 1.0, -0.4, 0.5, 0.6, -0.8])

    def at(time: float) -> np.ndarray:
        qpos = start.copy()
        mujoco.mj_integratePos(who.model, qpos, rate, time)
        return qpos

    poses = np.stack([at(time) for time in times])
    made = motion.from_qpos(who.model, poses, times, loop=False)
    grid = np.linspace(0.0, 1.29, 33)
    qpos, qvel = _sampler(who, made)(grid / CONTROL_DT)
    np.testing.assert_allclose(qpos, np.stack([at(time) for time in grid]), atol=1e-5)
    np.testing.assert_allclose(qvel, np.tile(rate, (33, 1)), atol=1e-4)


def test_times_may_begin_anywhere(who: Character):
    poses = tiny.walking()
    a = motion.from_qpos(who.model, poses, _times(poses), True)
    b = motion.from_qpos(who.model, poses, 5.0 + _times(poses), True)
    np.testing.assert_allclose(a.qpos, b.qpos, atol=1e-6)
    np.testing.assert_allclose(a.qvel, b.qvel, atol=1e-4)


@pytest.mark.parametrize("loop", [True, False])
def test_velocities_are_the_rates_of_the_poses(who: Character, loop: bool):
    poses = tiny.walking(121)
    made = motion.from_qpos(who.model, poses, _times(poses), loop, PLAIN)
    step = 1e-2
    phases = np.linspace(1.0, 28.0, 40)
    sample = _sampler(who, made)
    (ahead, _), (behind, _), (_, qvel) = (
        sample(phases + step),
        sample(phases - step),
        sample(phases),
    )
    found = pose.minus(who.layout, jnp.asarray(ahead), jnp.asarray(behind))
    found = np.asarray(found) / (2.0 * step * CONTROL_DT)
    np.testing.assert_allclose(qvel, found, atol=0.03)


def test_smoothing_calms_a_spike_and_keeps_a_steady_speed(who: Character):
    poses = tiny.walking()
    poses[:, [tiny.LEFT_HIP, tiny.RIGHT_HIP]] = 0.0
    poses[15, tiny.LEFT_HIP] = 0.3
    rough = motion.from_qpos(who.model, poses, _times(poses), True, PLAIN)
    calm = motion.from_qpos(who.model, poses, _times(poses), True)
    hip = tiny.LEFT_HIP - 2  # its displacement index
    assert np.abs(calm.qvel[:, hip]).max() < 0.7 * np.abs(rough.qvel[:, hip]).max()
    np.testing.assert_allclose(calm.qvel[:, 0], 0.5, atol=1e-4)
    np.testing.assert_allclose(calm.qvel.sum(0), rough.qvel.sum(0), atol=0.1)


@pytest.mark.parametrize(
    ("frames", "times"), [(1, [0.0]), (2, [0.0, 0.0])], ids=["one frame", "no duration"]
)
def test_what_is_no_motion_is_refused(who: Character, frames: int, times: list[float]):
    with pytest.raises(UserError, match="needs two frames and a duration, got") as raised:
        motion.from_qpos(who.model, tiny.standing(frames), np.array(times), False)
    assert "\n" not in str(raised.value)
