# SPDX-License-Identifier: Apache-2.0
"""Velocities in flight that obey mechanics. On the host.

Joint angles of a clip are good; the momentum that follows from them is not. In the flight of the
DeepMimic backflip, where the angular momentum about the centre of mass cannot change, it goes from
25 to 65 and back to 22 kg m^2/s. Who begins an episode there with it has no chance, whatever the
policy does. What gives way here is the velocity of the root; poses and joints stay.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills.character import Character
from jaxskills.motion import Motion
from jaxskills.retarget import posed

_ROOT = 1  # MuJoCo's body that the character's tree begins with, on a free joint
_AIRBORNE = 0.02  # m over the floor, of the lowest point; clips are off by that much
_SHORTEST = 3  # frames
_PARABOLA = 0.05  # m, so far the centre of mass may be from one, or it is not thrown
_TAKE_OFF = 0.1  # s before a flight, in which its momentum is gathered
_LEVEL = np.array([1.0, 1.0, 0.0])


class State(NamedTuple):
    """The whole body of one frame, in the world's axes."""

    center: np.ndarray  # [3] m, centre of mass
    velocity: np.ndarray  # [3] m/s, of it
    angular: np.ndarray  # [3] kg m^2/s, angular momentum about it
    inertia: np.ndarray  # [3, 3] kg m^2 about it, as if the body were stiff
    root: np.ndarray  # [3] m, where the root is
    axes: np.ndarray  # [3, 3] of the root


def ballistic(character: Character, motion: Motion) -> Motion:
    """Returns the motion with the velocities of a thrown body wherever nothing is near the floor.

    In each flight the centre of mass follows the parabola under gravity that is nearest to the
    clip's, and the angular momentum is the one that turns the body as far as the clip does. Before
    it, momentum leads up to that: who takes off with too little of it cannot get it in the air.
    Upwards it stays the clip's, as feet on the floor give it within a frame or two.
    """
    model, qpos, qvel = character.model, np.array(motion.qpos, float), np.array(motion.qvel, float)
    dt, gravity = motion.seconds / (len(qpos) - 1), model.opt.gravity
    states = [whole_body(model, *row) for row in zip(qpos, qvel, strict=True)]
    centers = np.array([state.center for state in states])
    for frames in flights(posed.look(model, qpos).lowest, centers, dt, gravity):
        begin = thrown(centers[frames], dt, gravity)[0]
        weights = [np.linalg.inv(states[i].inertia) for i in frames]
        turned = sum(w @ states[i].angular for w, i in zip(weights, frames, strict=True))
        angular = np.linalg.solve(np.sum(weights, axis=0), turned)
        for i in frames:
            velocity = begin + gravity * dt * (i - frames.start)
            qvel[i, :6] += root_change(states[i], velocity, angular)
        before = range(max(frames.start - round(_TAKE_OFF / dt), 0), frames.start)
        for i, share in zip(before, np.linspace(0.0, 1.0, len(before) + 2)[1:-1], strict=True):
            velocity = states[i].velocity + share * _LEVEL * (begin - states[i].velocity)
            more = share * (angular - states[i].angular)
            qvel[i, :6] += root_change(states[i], velocity, states[i].angular + more)
    return dataclasses.replace(motion, qvel=jnp.asarray(qvel, jnp.float32))


def flights(
    lowest: np.ndarray, centers: np.ndarray, dt: float, gravity: np.ndarray
) -> Iterator[range]:
    """Yields the runs of frames in which the body is thrown.

    Nothing is near the floor there, and the centre of mass follows a parabola. Where it does not,
    as feet float over the floor while they push off, frames are left out at either end.

    Args:
      lowest: `[F]` m, the lowest point over the floor.
      centers: `[F, 3]` m, the centre of mass.
      dt: s, from frame to frame.
      gravity: `[3]` m/s^2.
    """
    up = np.concatenate(([False], lowest > _AIRBORNE, [False]))
    begins, ends = np.flatnonzero(~up[:-1] & up[1:]), np.flatnonzero(up[:-1] & ~up[1:])
    for begin, end in zip(begins, ends, strict=True):
        off = lambda a, b: np.abs(thrown(centers[a:b], dt, gravity)[1]).max()  # noqa: E731
        while end - begin >= _SHORTEST and off(begin, end) > _PARABOLA:
            first = off(begin + 1, end) <= off(begin, end - 1)
            begin, end = begin + first, end - (not first)
        if end - begin >= _SHORTEST:
            yield range(begin, end)


def thrown(centers: np.ndarray, dt: float, gravity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the velocity `[3]` at the first of `centers [F, 3]` of the parabola that fits best.

    Also how far they are above it, `[F]` m. `dt` and `gravity` are those of `flights`.
    """
    time = dt * np.arange(len(centers))
    straight = centers - 0.5 * time[:, None] ** 2 * gravity
    velocity, begin = np.polyfit(time, straight, 1)
    return velocity, (straight - begin - time[:, None] * velocity)[:, 2]


def root_change(state: State, velocity: np.ndarray, angular: np.ndarray) -> np.ndarray:
    """Returns what to add to the root's six velocities for this velocity and angular momentum.

    `velocity [3]` is that of the centre of mass. The free joint turns about the root's own axes.
    """
    turn = np.linalg.solve(state.inertia, angular - state.angular)
    push = velocity - state.velocity - np.cross(turn, state.center - state.root)
    return np.concatenate((push, state.axes.T @ turn))


def whole_body(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> State:
    """Returns what the character as a whole does in a state `[nq]`, `[nv]`."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    center, inertia = data.subtree_com[_ROOT], np.zeros((3, 3))
    for body in np.flatnonzero(model.body_rootid == _ROOT):
        own, apart = data.ximat[body].reshape(3, 3), data.xipos[body] - center
        about = np.dot(apart, apart) * np.eye(3) - np.outer(apart, apart)
        inertia += own @ np.diag(model.body_inertia[body]) @ own.T + model.body_mass[body] * about
    return State(
        center,
        data.subtree_linvel[_ROOT],
        data.subtree_angmom[_ROOT],
        inertia,
        data.xpos[_ROOT],
        data.xmat[_ROOT].reshape(3, 3),
    )
