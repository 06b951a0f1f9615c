# SPDX-License-Identifier: Apache-2.0
"""Reader of DeepMimic motion files (Peng et al. 2018): JSON, 44 numbers a frame, y up.

A frame is: duration, root position, root quaternion, then the joints of `_JOINTS` in order, four
numbers (w, x, y, z) for a ball joint and one angle for a hinge about the body's lateral axis.
"""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills.clip.data import Clip, Skeleton, build
from jaxskills.errors import UserError, unknown

# name, kind, parent, offset from the parent in m (x forward, y left, z up): the file format's own
# 45 kg humanoid, `humanoid3d.txt`.
_JOINTS = (
    ("chest", "ball", None, (0.0, 0.0, 0.236151)),
    ("neck", "ball", "chest", (0.0, 0.0, 0.223894)),
    ("right_hip", "ball", None, (0.0, -0.084887, 0.0)),
    ("right_knee", "hinge", "right_hip", (0.0, 0.0, -0.421546)),
    ("right_ankle", "ball", "right_knee", (0.0, 0.0, -0.409870)),
    ("right_shoulder", "ball", "chest", (-0.02405, -0.18311, 0.2435)),
    ("right_elbow", "hinge", "right_shoulder", (0.0, 0.0, -0.274788)),
    ("left_hip", "ball", None, (0.0, 0.084887, 0.0)),
    ("left_knee", "hinge", "left_hip", (0.0, 0.0, -0.421546)),
    ("left_ankle", "ball", "left_knee", (0.0, 0.0, -0.409870)),
    ("left_shoulder", "ball", "chest", (-0.02405, 0.18311, 0.2435)),
    ("left_elbow", "hinge", "left_shoulder", (0.0, 0.0, -0.274788)),
)
JOINTS = tuple(name for name, *_ in _JOINTS)
HINGE_AXIS = (0.0, -1.0, 0.0)  # z of the file, to the right, in z up

_HUGE = 1e12  # beyond it, as good as infinite
_WIDTHS = {"ball": 4, "hinge": 1}
_COLUMNS = (
    "duration",
    *("root position",) * 3,
    *("root quaternion",) * 4,
    *(name for name, kind, *_ in _JOINTS for _ in range(_WIDTHS[kind])),
)


def read(path: Path) -> Clip:
    """Returns the clip of one DeepMimic file, turned to z up.

    Raises:
      UserError: not such a file, or broken; the message names the frame and the column.
    """
    table, loop = _parse(path)
    if len(table) < 2:
        raise UserError(f"clip '{path}' has {len(table)} frame(s): at least 2 are needed")
    durations = table[:, 0]
    # The last frame's own duration has no meaning: there is no frame after it.
    wrong = np.flatnonzero(durations[:-1] <= 0)
    if wrong.size:
        raise UserError(
            f"clip '{path}': frame {wrong[0]} lasts {durations[wrong[0]]:g} s:"
            " durations must be > 0"
        )
    rotations = np.zeros((len(table), len(_JOINTS), 4))
    file_angles = {}
    column = 8
    for index, (name, kind, *_) in enumerate(_JOINTS):
        if kind == "ball":
            rotations[:, index] = z_up(table[:, column : column + 4])
        else:
            angle = table[:, column]
            turns = Rotation.from_rotvec(angle[:, None] * np.array(HINGE_AXIS))
            rotations[:, index] = turns.as_quat(scalar_first=True)
            file_angles[name] = float(np.abs(angle).max())
        column += _WIDTHS[kind]
    return build(
        str(path),
        path.stem.removeprefix("humanoid3d_"),
        np.concatenate([[0.0], np.cumsum(durations[:-1])]),
        JOINTS,
        z_up(table[:, 1:4]),
        z_up(table[:, 4:8]),
        rotations,
        loop=loop,
        skeleton=skeleton(),
        file_angles=file_angles,
    )


def skeleton() -> Skeleton:
    """Returns the skeleton of the file format's humanoid."""
    parents = tuple(-1 if parent is None else JOINTS.index(parent) for _, _, parent, _ in _JOINTS)
    return Skeleton(parents, np.array([offset for *_, offset in _JOINTS]))


def z_up(array: np.ndarray) -> np.ndarray:
    """Returns vectors [..., 3] or quaternions [..., 4] (wxyz) turned from y up to z up.

    x stays forward, the file's z (right) becomes -y: (x, y, z) -> (x, -z, y).
    """
    array = np.asarray(array)
    vector = np.stack([array[..., -3], -array[..., -1], array[..., -2]], axis=-1)
    return np.concatenate([array[..., :-3], vector], axis=-1)


def _parse(path: Path) -> tuple[np.ndarray, bool]:
    """Returns (frames [F,44], whether the clip loops)."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"clip '{path}' cannot be read as text: {error}") from None
    if not text.strip():
        raise UserError(f"clip '{path}' is empty")
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        cut = text.lstrip().startswith("{") and not text.rstrip().endswith("}")
        what = "ends early (truncated JSON)" if cut else "is not JSON"
        where = f"line {error.lineno}, column {error.colno}"
        raise UserError(f"clip '{path}' {what}: {error.msg}, {where}") from None
    if not isinstance(content, dict) or not isinstance(content.get("Frames"), list):
        raise UserError(f"clip '{path}': no list 'Frames' in it: not a DeepMimic motion file")
    loop = content.get("Loop", "none")
    if loop not in ("wrap", "none"):
        raise unknown(f"Loop in '{path}'", loop, ("wrap", "none"))
    return _table(path, content["Frames"]), loop == "wrap"


def _table(path: Path, frames: list) -> np.ndarray:
    for index, frame in enumerate(frames):
        if not isinstance(frame, list):
            raise UserError(f"clip '{path}': frame {index} is not a list of numbers")
        if len(frame) != len(_COLUMNS):
            raise UserError(
                f"clip '{path}': frame {index} has {len(frame)} numbers:"
                f" expected {len(_COLUMNS)} (a DeepMimic humanoid)"
            )
        for column, value in enumerate(frame):
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not abs(value) < _HUGE:
                raise UserError(
                    f"clip '{path}': frame {index}, column {column} ({_COLUMNS[column]}) is"
                    f" {value}: expected a finite number"
                )
    return np.array(frames, float).reshape(-1, len(_COLUMNS))
