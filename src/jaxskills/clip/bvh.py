# SPDX-License-Identifier: Apache-2.0
"""Reader of BVH files through `pybvh` (the `bvh` extra): any up axis, any length unit."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills.clip import roles
from jaxskills.clip.data import Clip, Skeleton, build
from jaxskills.errors import UserError

# BVH says nothing of its length unit; a leg (hip to ankle) of about this length tells it.
_LEG = 0.83
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
_CMU_UNIT = 0.0254 / 0.45  # the CMU database: inches divided by 0.45


def read(path: Path) -> Clip:
    """Returns the clip of one BVH file, turned to z up with x forward, in metres.

    The up axis is the one along which the zero pose stands, forward is where its toes point, the
    unit the one that makes a human leg. All three are named in the notes.

    Raises:
      UserError: `pybvh` is not installed, or the file is broken.
    """
    if importlib.util.find_spec("pybvh") is None:
        raise UserError(f"clip '{path}': BVH needs pybvh: run pip install 'jaxskills[bvh]'")
    import pybvh

    try:
        if not path.read_text(encoding="utf-8-sig").strip():
            raise UserError(f"clip '{path}' is empty")
        bvh = pybvh.read_bvh_file(path, world_up="+y")
    except UserError:
        raise
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as error:
        raise UserError(f"clip '{path}' is not a sound BVH file: {_line(error)}") from None
    _finite(path, bvh)
    nodes = [node for node in bvh.nodes if not node.is_end_site()]
    names = tuple(node.name for node in nodes)
    if len(names) < 2:
        raise UserError(f"clip '{path}' has no joint besides its root")
    parents = tuple(names.index(node.parent.name) - 1 for node in nodes[1:] if node.parent)
    offsets = np.array([node.offset for node in nodes[1:]])
    raw = Skeleton(parents, offsets)
    turn, axes = _turn(path, raw, names[1:], _tips(bvh, names))
    unit, unit_name = _unit(raw, names[1:])
    matrices = bvh.to_rotmat()[1]  # [F, 1+J, 3, 3]
    turned = Rotation.from_matrix((turn @ matrices @ turn.T).reshape(-1, 3, 3))
    local = turned.as_quat(scalar_first=True).reshape(len(matrices), -1, 4)
    steps = bvh.frame_time
    peaks = np.abs(bvh.joint_angles).max(axis=(0, 2))
    return build(
        str(path),
        path.stem,
        np.arange(len(local)) * steps,
        names[1:],
        unit * bvh.root_pos @ turn.T,
        local[:, 0],
        local[:, 1:],
        loop=False,
        notes=(axes, f"lengths read as {unit_name}", "BVH does not say if it loops: read as not"),
        skeleton=Skeleton(parents, unit * offsets @ turn.T),
        file_angles=dict(zip(names[1:], map(float, peaks[1:]), strict=True)),
    )


def _finite(path: Path, bvh: Any) -> None:
    frames = np.concatenate([bvh.root_pos, bvh.joint_angles.reshape(len(bvh.root_pos), -1)], axis=1)
    bad = np.flatnonzero(~np.isfinite(frames).all(axis=1))
    if bad.size:
        raise UserError(f"clip '{path}': frame {bad[0]} holds a number that is not finite")
    for node in bvh.nodes:
        if not np.isfinite(node.offset).all():
            raise UserError(f"clip '{path}': the offset of {node.name} is not finite")


def _tips(bvh: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Returns where end sites point, by joint."""
    sites = [node for node in bvh.nodes if node.is_end_site()]
    return {node.parent.name: np.array(node.offset) for node in sites if node.parent.name in names}


def _turn(
    path: Path, raw: Skeleton, names: tuple[str, ...], tips: dict[str, np.ndarray]
) -> tuple[np.ndarray, str]:
    """Returns the matrix [3,3] from file axes to x forward, z up, and a note."""
    found = roles.of(names)
    index = {role: names.index(joint) for role, joint in found.items()}
    at = raw.positions()
    feet = [index[r] for r in ("left_ankle", "right_ankle") if r in index]
    high = [index[r] for r in ("head", "neck") if r in index] or [-1]
    if not feet:
        up = np.array([0.0, 1.0, 0.0])
        note = "no feet among the joint names: read as y up, z forward"
        return np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), note
    top = at[high[0]] if high[0] >= 0 else np.zeros(3)
    up = _axis(top - at[feet].mean(axis=0))
    forward = _forward(raw, names, index, tips, at, up)
    if abs(forward @ up) > 0.5:
        raise UserError(f"clip '{path}': the zero pose has no forward: feet and hips lie in a line")
    turn = np.stack([forward, np.cross(up, forward), up])
    return turn, f"{_axis_name(up)} is up and {_axis_name(forward)} forward at its zero pose"


def _forward(
    raw: Skeleton,
    names: tuple[str, ...],
    index: dict[str, int],
    tips: dict[str, np.ndarray],
    at: np.ndarray,
    up: np.ndarray,
) -> np.ndarray:
    """Returns the signed axis along which the toes point, else left of which the left hip lies."""
    pointing = np.zeros(3)
    for side in ("left", "right"):
        ankle = index.get(f"{side}_ankle")
        if ankle is None:
            continue
        below = [j for j, parent in enumerate(raw.parents) if parent == ankle]
        for offset in [raw.offsets[j] for j in below] + [tips.get(names[ankle], np.zeros(3))]:
            pointing += offset - up * (offset @ up)
    if np.linalg.norm(pointing) > 0.02 * np.linalg.norm(at[index["left_ankle"]]):
        return _axis(pointing)
    left = at[index["left_hip"]] - at[index["right_hip"]]
    return _axis(np.cross(left, up))


def _unit(raw: Skeleton, names: tuple[str, ...]) -> tuple[float, str]:
    """Returns metres per unit of the file, and the unit's name."""
    leg = roles.leg_length(names, raw)
    if leg is None:
        return 0.01, "centimetres (no leg among the joint names to measure)"
    units = {**_UNITS, "CMU units (5.64 cm)": _CMU_UNIT}
    best = min(units, key=lambda name: abs(np.log(units[name] * leg / _LEG)))
    return units[best], f"{best} (its leg is then {units[best] * leg:.2f} m)"


def _axis(vector: np.ndarray) -> np.ndarray:
    """Returns the signed unit axis nearest to `vector`."""
    axis = np.zeros(3)
    largest = int(np.argmax(np.abs(vector)))
    axis[largest] = np.sign(vector[largest])
    return axis


def _axis_name(axis: np.ndarray) -> str:
    largest = int(np.argmax(np.abs(axis)))
    return ("+" if axis[largest] > 0 else "-") + "xyz"[largest]


def _line(error: Exception) -> str:
    return " ".join(str(error).split(";")[0].split())
