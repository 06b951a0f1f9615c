# SPDX-License-Identifier: Apache-2.0
"""Reference motions: poses over a continuous phase, looped or held at the end.

The unit of phase is the control frame (1/30 s), so a phase step of 1 is normal speed and the
discount keeps its usual meaning under time warps (FS section 3).
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import pose, rotation
from jaxskills.errors import UserError

CONTROL_DT = 1.0 / 30.0  # s, SB section 5 and FS section 7


@struct.dataclass
class Motion:
    """F poses at even steps of phase, first and last included. Arrays, so variants can stack."""

    qpos: jax.Array  # [F, nq]
    qvel: jax.Array  # [F, nv] per second
    length: jax.Array  # [] control frames from the first pose to the last
    cycle_pos: jax.Array  # [3] m, what one cycle adds to the root position (0 without loop)
    cycle_yaw: jax.Array  # [] rad, what one cycle adds to the heading
    loop: bool = struct.field(pytree_node=False)

    @property
    def seconds(self) -> float:
        """Duration of one cycle in s."""
        return float(self.length) * CONTROL_DT


@dataclasses.dataclass(frozen=True)
class MotionConfig:
    """How a clip's poses become a reference."""

    loop: bool = True  # off: a clip that loops is done once
    close_loop: float = 0.15  # s on either side of the seam over which a loop's gap is spread
    smooth_velocity: float = 0.03  # s, width of the Gaussian that calms spiking velocities
    ballistic: bool = False  # velocities in flight are those of a thrown body, see `flight`
    start: float = 0.0  # s, where the part of the clip begins that is learnt
    end: float | None = None  # s, where it ends; None: with the clip. A part does not loop
    turn_with_cycle: bool = False  # the heading gained in a cycle is kept (DeepMimic: off)


def from_qpos(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    times: np.ndarray,
    loop: bool,
    config: MotionConfig = MotionConfig(),  # noqa: B008  frozen
) -> Motion:
    """Returns the motion through the poses `qpos [F, nq]` at `times [F]` (s).

    Unequal time steps are resampled, the gap of a loop is spread around its seam, and velocities
    are central differences.

    Raises:
      UserError: fewer than two frames or a length that is not positive.
    """
    if len(qpos) < 2 or not times[-1] > times[0]:
        raise UserError(f"a motion needs two frames and a duration, got {len(qpos)} frames")
    duration = float(times[-1] - times[0])
    frames = max(len(qpos), round(duration / CONTROL_DT) + 1)
    even = np.linspace(times[0], times[-1], frames)
    poses = np.stack([_pose_at(model, qpos, times, t) for t in even])
    yaw, step = 0.0, np.zeros(3)
    if loop:
        yaw = _yaw_gained(poses) if config.turn_with_cycle else 0.0
        turned = _turn(poses[0], yaw)
        step = np.array([*(poses[-1] - turned)[:2], 0.0])
        poses = _close(model, poses, yaw, step, config.close_loop * (frames - 1) / duration)
    dt = duration / (frames - 1)
    qvel = _velocities(model, poses, dt, loop, yaw, step)
    qvel = _smooth(qvel, config.smooth_velocity / dt, loop, yaw)
    as_array = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    arrays = (poses, qvel, duration / CONTROL_DT, step, yaw)
    return Motion(*(as_array(x) for x in arrays), loop=loop)


def sample(layout: pose.Layout, motion: Motion, phase: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the pose `[nq]` and velocity `[nv]` at `phase []` (control frames, any size).

    A looped motion goes on for ever, each cycle added to the ones before; any other stays at its
    last pose, at rest.
    """
    intervals = motion.qpos.shape[0] - 1
    cycle = jnp.floor(phase / motion.length) if motion.loop else jnp.zeros_like(phase)
    inside = jnp.clip(phase - cycle * motion.length, 0.0, motion.length)
    place = inside / motion.length * intervals
    index = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, intervals - 1)
    share = place - index
    qpos = pose.lerp(layout, motion.qpos[index], motion.qpos[index + 1], share)
    qvel = motion.qvel[index] + share * (motion.qvel[index + 1] - motion.qvel[index])
    if not motion.loop:
        return qpos, jnp.where(phase < motion.length, qvel, 0.0)
    return _after_cycles(motion, cycle, qpos, qvel)


def fold(
    layout: pose.Layout, motion: Motion, qpos: jax.Array, qvel: jax.Array, phase: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns a state `[nq]`, `[nv]` and its `phase []` moved back into the first cycle.

    It is turned back by the yaw of the cycles gone by, and its root is put on the reference's,
    horizontally, so what it had drifted is forgiven, unless there are objects to be met at their
    places. A motion without loop has one cycle.
    """
    cycle = jnp.floor(phase / motion.length) if motion.loop else jnp.zeros_like(phase)
    inside = jnp.clip(phase - cycle * motion.length, 0.0, motion.length)
    back = rotation.about_z(-cycle * motion.cycle_yaw)
    at = qpos[:2] if layout.others else sample(layout, motion, inside)[0][:2]
    rot = rotation.mul(back, qpos[3:7])
    qpos = jnp.concatenate((at, qpos[2:3], rot, qpos[7:]))
    return qpos, jnp.concatenate((rotation.rotate(back, qvel[:3]), qvel[3:])), inside


def _after_cycles(
    motion: Motion, cycle: jax.Array, qpos: jax.Array, qvel: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns pose and velocity moved on by whole cycles, each a turn and a step."""
    turn = rotation.about_z(cycle * motion.cycle_yaw)
    half = 0.5 * motion.cycle_yaw
    # The sum of `cycle` steps, each turned once more than the one before (a chord of a circle).
    straight = jnp.abs(half) < 1e-6
    chord = jnp.sin(cycle * half) / jnp.where(straight, 1.0, jnp.sin(half))
    moved = jnp.where(straight, cycle, chord) * rotation.rotate(
        rotation.about_z((cycle - 1.0) * half), motion.cycle_pos
    )
    pos = rotation.rotate(turn, qpos[:3]) + moved
    rot = rotation.mul(turn, qpos[3:7])
    qpos = jnp.concatenate((pos, rot, qpos[7:]))
    return qpos, jnp.concatenate((rotation.rotate(turn, qvel[:3]), qvel[3:]))


def _pose_at(model: mujoco.MjModel, qpos: np.ndarray, times: np.ndarray, t: float) -> np.ndarray:
    """Returns the pose at time `t`, between its neighbours on the pose manifold."""
    i = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
    share = (t - times[i]) / (times[i + 1] - times[i])
    return _plus(model, qpos[i], share * _minus(model, qpos[i + 1], qpos[i]))


def _plus(model: mujoco.MjModel, qpos: np.ndarray, d: np.ndarray) -> np.ndarray:
    moved = np.array(qpos, float)
    mujoco.mj_integratePos(model, moved, np.asarray(d, float), 1.0)
    return moved


def _minus(model: mujoco.MjModel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, d, 1.0, np.asarray(b, float), np.asarray(a, float))
    return d


def _yaw_gained(poses: np.ndarray) -> float:
    """Returns the turn about the vertical from the first root orientation to the last."""
    back, turned = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, poses[0, 3:7])
    mujoco.mju_mulQuat(turned, poses[-1, 3:7], back)
    return float(np.remainder(2.0 * np.arctan2(turned[3], turned[0]) + np.pi, 2 * np.pi) - np.pi)


def _turn(qpos: np.ndarray, yaw: float, step: np.ndarray | None = None) -> np.ndarray:
    """Returns the pose turned about the vertical axis through the origin, then moved by `step`."""
    quat, moved = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), np.array(qpos, float)
    mujoco.mju_rotVecQuat(moved[:3], qpos[:3], quat)
    mujoco.mju_mulQuat(moved[3:7], quat, qpos[3:7])
    if step is not None:
        moved[:3] += step
    return moved


def _close(
    model: mujoco.MjModel, poses: np.ndarray, yaw: float, step: np.ndarray, window: float
) -> np.ndarray:
    """Returns the poses with the loop's gap spread over `window` frames before and after the seam.

    Both ends move half of the gap, to the pose in the middle, so the seam is continuous.
    """
    last = len(poses) - 1
    window = min(max(window, 1.0), last / 2)
    back = _turn(_turn(poses[-1], 0.0, -step), -yaw)
    at_start = 0.5 * _minus(model, back, poses[0])
    at_end = 0.5 * _minus(model, _turn(poses[0], yaw, step), poses[-1])
    closed = []
    for i, qpos in enumerate(poses):
        start = max(0.0, 1.0 - i / window)
        end = max(0.0, 1.0 - (last - i) / window)
        ease = lambda s: s * s * (3.0 - 2.0 * s)  # noqa: E731
        qpos = _plus(model, qpos, ease(start) * at_start)
        closed.append(_plus(model, qpos, ease(end) * at_end))
    return np.stack(closed)


def _velocities(
    model: mujoco.MjModel, poses: np.ndarray, dt: float, loop: bool, yaw: float, step: np.ndarray
) -> np.ndarray:
    """Returns central differences `[F, nv]`; at the ends across the seam, or one-sided."""
    before = [_turn(_turn(poses[-2], 0.0, -step), -yaw)] if loop else [poses[0]]
    after = [_turn(poses[1], yaw, step)] if loop else [poses[-1]]
    around = np.concatenate((before, poses, after))
    qvel = np.stack(
        [_minus(model, around[i + 2], around[i]) / (2.0 * dt) for i in range(len(poses))]
    )
    if not loop:
        qvel[[0, -1]] *= 2.0
    return qvel


def _smooth(qvel: np.ndarray, width: float, loop: bool, yaw: float) -> np.ndarray:
    """Returns the velocities under a Gaussian of `width` frames along time."""
    reach = int(np.ceil(3.0 * width))
    if reach == 0:
        return qvel
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    weights /= weights.sum()
    if loop:
        # The last frame is the first of the next cycle: leave it out, wrap, and put it back.
        index = np.arange(-reach, len(qvel) + reach)
        padded = qvel[index % (len(qvel) - 1)]
        # Each cycle is turned once more than the one before.
        turn = index // (len(qvel) - 1) * yaw
        x, y = padded[:, 0].copy(), padded[:, 1].copy()
        padded[:, 0] = np.cos(turn) * x - np.sin(turn) * y
        padded[:, 1] = np.sin(turn) * x + np.cos(turn) * y
    else:
        padded = np.pad(qvel, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([weights @ padded[i : i + 2 * reach + 1] for i in range(len(qvel))])
