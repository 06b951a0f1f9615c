# SPDX-License-Identifier: Apache-2.0
"""Variations to test with, and what MuJoCo itself makes of them."""

import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills.motion import Motion
from jaxskills.variation import Variation


def smooth(knots: int, nv: int, seed: int = 0, size: float = 0.3, speed: float = 0.4) -> Variation:
    """Returns a random variation of a few slow waves that begins at 0."""
    random = np.random.default_rng(seed)
    turn = 2.0 * np.pi * np.linspace(0.0, 1.0, knots)[:, None]
    waves = [np.sin(n * turn / 2.0) * random.normal(0.0, 1.0 / n, nv + 1) for n in (1, 2, 3)]
    rows = np.sum(waves, axis=0)
    scaled = lambda x, s: jnp.asarray(s * x / np.abs(x).max(), jnp.float32)  # noqa: E731
    return Variation(scaled(rows[:, :nv], size), scaled(rows[:, nv], speed))


def plus(model: mujoco.MjModel, qpos: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Returns the pose that MuJoCo reaches from `qpos` by `d`."""
    moved = np.array(qpos, float)
    mujoco.mj_integratePos(model, moved, np.asarray(d, float), 1.0)
    return moved


def minus(model: mujoco.MjModel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the displacement from `b` to `a` that MuJoCo finds."""
    d = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, d, 1.0, np.asarray(b, float), np.asarray(a, float))
    return d


def reference_at(model: mujoco.MjModel, motion: Motion, phase: float) -> np.ndarray:
    """Returns the pose of a motion at a phase of its first cycle."""
    poses = np.asarray(motion.qpos, float)
    place = phase / float(motion.length) * (len(poses) - 1)
    low = int(np.clip(np.floor(place), 0, len(poses) - 2))
    share = np.clip(place - low, 0.0, 1.0)
    return plus(model, poses[low], share * minus(model, poses[low + 1], poses[low]))


def varied_at(
    model: mujoco.MjModel, motion: Motion, variation: Variation, phase: float
) -> np.ndarray:
    """Returns the pose of the varied motion at a phase, FS eq. 1 and 2 word by word."""
    knots = np.linspace(0.0, float(motion.length), len(variation.tau))
    d = [np.interp(phase, knots, column) for column in np.asarray(variation.d, float).T]
    return plus(model, reference_at(model, motion, phase), np.array(d))


def speed_at(motion: Motion, variation: Variation, phase: float) -> float:
    """Returns the speed of phase there."""
    knots = np.linspace(0.0, float(motion.length), len(variation.tau))
    return float(np.exp(np.interp(phase, knots, np.asarray(variation.tau, float))))


def turned(qpos: np.ndarray, yaw: float, shift: tuple[float, float]) -> np.ndarray:
    """Returns poses `[T, nq]` turned about the vertical through the origin, then shifted."""
    quat, moved = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), np.array(qpos, float)
    for row, source in zip(moved, np.asarray(qpos, float), strict=True):
        mujoco.mju_rotVecQuat(row[:3], source[:3], quat)
        mujoco.mju_mulQuat(row[3:7], quat, source[3:7])
    moved[:, :2] += shift
    return moved
