# SPDX-License-Identifier: Apache-2.0
"""What is filmed, checked, and from where: the way the camera and the ghost go."""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.render import stage

# Seconds over which the camera evens out the way of the root: sideways, and up and down.
_STEADY = np.array([0.3, 0.3, 0.6])

# In statures: how far beside the simulation the ghost goes, and how far the two may drift apart.
_ASIDE = 0.8
_LEASH = 0.3


@dataclasses.dataclass(frozen=True, eq=False)
class Take:
    """T poses at `fps` and the reference at the same times."""

    character: Character
    qpos: np.ndarray  # [T, nq]
    reference: np.ndarray | None  # [T, nq]
    labels: tuple[str, ...]  # [T]
    fps: float
    heading: float  # rad, direction of travel
    body: float  # m, stature of the character
    name: str = ""  # of the take, where there are several


def checked(
    character: Character,
    qpos: np.ndarray,
    reference: np.ndarray | None,
    labels: Sequence[str] | None,
    fps: float,
) -> Take:
    """Returns the take, up to the first pose that is not finite (a simulation may diverge).

    Labels are the time in s unless given.

    Raises:
      UserError: a wrong number of poses, coordinates or labels; no finite pose at the beginning.
    """
    if not fps > 0:
        raise UserError(f"fps is {fps}: give a number > 0")
    qpos = _poses(character, "qpos", qpos)
    if labels is None:
        labels = [f"{i / fps:.2f} s" for i in range(len(qpos))]
    if len(labels) != len(qpos):
        raise UserError(f"there are {len(labels)} labels: qpos has {len(qpos)} poses")
    good = np.isfinite(qpos.sum(1))
    if reference is not None:
        reference = _poses(character, "reference_qpos", reference)
        if len(reference) != len(qpos):
            raise UserError(f"reference_qpos has {len(reference)} poses: qpos has {len(qpos)}")
        good &= np.isfinite(reference.sum(1))
    end = len(good) if good.all() else int(good.argmin())
    if end == 0:
        raise UserError("nothing to film: the first pose is not finite")
    qpos, reference = qpos[:end], None if reference is None else reference[:end]
    body = stage.stature(character.model, character.forward)
    heading = _heading(character, qpos if reference is None else reference, body)
    return Take(character, qpos, reference, tuple(labels[:end]), fps, heading, body)


def lookat(take: Take, qpos: np.ndarray) -> np.ndarray:
    """Returns the points [T, 3] in m where the camera looks: the root of poses [T, nq], steady."""
    return np.stack([_smooth(qpos[:, i], _STEADY[i] * take.fps) for i in range(3)], 1)


def beside(take: Take, reference: np.ndarray) -> np.ndarray:
    """Returns the reference [T, nq] left of the simulation, pulled along where it drifts off."""
    drift = reference[:, :2] - take.qpos[:, :2]
    apart = np.linalg.norm(drift, axis=1, keepdims=True)
    excess = np.maximum(1.0 - _LEASH * take.body / np.maximum(apart, 1e-9), 0.0)
    left = np.array([-np.sin(take.heading), np.cos(take.heading)])
    moved = reference.copy()
    moved[:, :2] += _ASIDE * take.body * left - excess * drift
    return moved


def _poses(character: Character, name: str, given: np.ndarray) -> np.ndarray:
    poses, nq = np.asarray(given, float), character.model.nq
    if poses.ndim != 2 or poses.shape[1] != nq or not len(poses):
        raise UserError(f"{name} has shape {poses.shape}: {character.name} needs (T, {nq}), T > 0")
    return poses


def _heading(character: Character, qpos: np.ndarray, body: float) -> float:
    """Returns the direction of travel in rad, or the facing of the root if it stays in place."""
    way = qpos[-1, :2] - qpos[0, :2]
    if np.linalg.norm(way) < 0.4 * body:
        facing = np.empty(3)
        mujoco.mju_rotVecQuat(facing, character.forward, qpos[0, 3:7])
        way = facing[:2]
    return float(np.arctan2(way[1], way[0]))


def _smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    """Returns values [T] under a Gaussian of `sigma` samples; past the ends they move on evenly."""
    reach = int(3 * sigma) + 1
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
