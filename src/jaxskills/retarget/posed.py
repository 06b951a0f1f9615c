# SPDX-License-Identifier: Apache-2.0
"""Poses looked at with MuJoCo on the host: where bodies are, what touches what."""

import dataclasses
import itertools

import mujoco
import numpy as np

_FAR = 1e4  # m, beyond which a geom's distance to the floor does not matter
_APART = 0.005  # m, geoms closer than this at the zero pose belong together


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """F poses seen in the world. B bodies with the world as body 0."""

    positions: np.ndarray  # [F,B,3] m
    turns: np.ndarray  # [F,B,3,3] from the zero pose to the pose
    lowest: np.ndarray  # [F] m, lowest point of the character above the floor; < 0 is inside
    overlap: np.ndarray  # [F] m, depths by which its parts run into each other, summed


def look(model: mujoco.MjModel, qpos: np.ndarray, overlap: bool = False) -> Look:
    """Returns what `qpos [F,nq]` looks like; overlaps are 0 unless asked for."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    zero = data.xmat.reshape(-1, 3, 3).copy()
    floor, geoms = model.geom("floor").id, _solid_geoms(model)
    pairs = _pairs(model, data, geoms) if overlap else []
    positions, turns, lowest, depth = [], [], [], []
    for pose in qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        positions.append(data.xpos.copy())
        turns.append(data.xmat.reshape(-1, 3, 3) @ zero.swapaxes(1, 2))
        lowest.append(min(_distance(model, data, floor, geom, _FAR) for geom in geoms))
        depth.append(sum(-min(_distance(model, data, a, b, 0.0), 0.0) for a, b in pairs))
    return Look(np.array(positions), np.array(turns), np.array(lowest), np.array(depth, float))


def _distance(model: mujoco.MjModel, data: mujoco.MjData, a: int, b: int, far: float) -> float:
    return mujoco.mj_geomDistance(model, data, a, b, far, None)


def _solid_geoms(model: mujoco.MjModel) -> list[int]:
    """Returns the geoms of moving bodies that can touch something."""
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    collide = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    moving = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] > 0]
    return [geom for geom in moving if collide[geom] or geom in paired] or moving


def _pairs(model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int]) -> list[tuple[int, int]]:
    """Returns the geom pairs that are apart at the zero pose (the one `data` is in)."""
    return [
        (a, b)
        for a, b in itertools.combinations(geoms, 2)
        if model.geom_bodyid[a] != model.geom_bodyid[b]
        and _distance(model, data, a, b, 1.0) > _APART
    ]
