# SPDX-License-Identifier: Apache-2.0
"""Clips authored by hand: a few key poses in degrees, in Python or a TOML file, made into a clip.

A TOML file reads like this (see `data/clips`):

    loop = true
    interpolation = "linear"    # or "spline"
    duration = 0.7              # s; with `loop` the first pose comes back then
    travel = [1.5, 0.0, 0.0]    # m, how far the root gets in one cycle

    [joints]                    # axes of each joint's angles, in order; - turns one round
    root = "zyx"
    right_hip = "-yxz"          # 30, 0, 0 swings the leg forward
    right_knee = "y"            # one axis is a hinge

    [[poses]]
    time = 0.0
    position = [0.0, 0.0, 0.83] # m, of the root
    right_hip = [28, 0, 0]      # degrees
    right_knee = 18

A pose need not name every joint: what it leaves out lies between the poses that do.
"""

import dataclasses
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from jaxskills.clip import deepmimic
from jaxskills.clip.data import Clip, build
from jaxskills.errors import UserError, unknown

INTERPOLATIONS = ("linear", "spline")
_AXES = re.compile(r"(-?[xyz]){1,3}")


@dataclasses.dataclass(frozen=True)
class Key:
    """One key pose. Joints and position left out lie between the keys that have them."""

    time: float  # s
    angles: Mapping[str, float | Sequence[float]]  # degrees, by joint; `root` is one
    position: Sequence[float] | None = None  # m, of the root


@dataclasses.dataclass(frozen=True)
class Keyframes:
    """Key poses and how to go from one to the next."""

    name: str
    axes: Mapping[
        str, str
    ]  # joint -> axes of its angles, 'y', '-yxz'; each turn about the new axis
    keys: Sequence[Key]
    interpolation: str = "linear"  # linear and slerp, or 'spline' (smooth also at the keys)
    loop: bool = False
    duration: float | None = None  # s; of a loop, when the first key comes back; else the last key
    travel: Sequence[float] = (0.0, 0.0, 0.0)  # m, root displacement of one cycle
    rate: float = 30.0  # Hz, of the clip made


def read(path: Path) -> Clip:
    """Returns the clip of a keyframe TOML file.

    Raises:
      UserError: not valid TOML, an unknown entry, or what `compile` rejects.
    """
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UserError(
            f"keyframes '{path}' cannot be read: {' '.join(str(error).split())}"
        ) from None
    options = ("interpolation", "loop", "duration", "travel", "rate")
    for entry in raw:
        if entry not in (*options, "joints", "poses"):
            raise unknown(f"entry in '{path}'", entry, (*options, "joints", "poses"))
    for entry, kind in (("joints", dict), ("poses", list)):
        if not isinstance(raw.get(entry), kind):
            raise UserError(f"keyframes '{path}': no [joints] table and [[poses]] list in it")
    keys = []
    for pose in raw["poses"]:
        angles = {name: v for name, v in pose.items() if name not in ("time", "position")}
        if "time" not in pose:
            raise UserError(f"keyframes '{path}': pose {len(keys)} has no time")
        keys.append(Key(pose["time"], angles, pose.get("position")))
    given = {option: raw[option] for option in options if option in raw}
    return compile(Keyframes(path.stem, raw["joints"], keys, **given))


def compile(keyframes: Keyframes) -> Clip:  # noqa: A001
    """Returns the clip through the key poses, sampled at `rate`.

    If all joints are DeepMimic's, the clip has DeepMimic's skeleton and all its joints.

    Raises:
      UserError: unknown joint or interpolation, wrong number of angles, times that do not increase,
        a loop without duration.
    """
    _check(keyframes)
    end = _end(keyframes)
    times = np.linspace(0.0, end, max(round(end * keyframes.rate), 1) + 1)
    joints = tuple(name for name in keyframes.axes if name != "root")
    skeleton = None
    if set(joints) <= set(deepmimic.JOINTS):
        joints, skeleton = deepmimic.JOINTS, deepmimic.skeleton()
    turned = {name: _turns(keyframes, name, times) for name in ("root", *joints)}
    return build(
        keyframes.name,
        keyframes.name,
        times,
        joints,
        _positions(keyframes, times),
        turned["root"],
        np.stack([turned[name] for name in joints], axis=1),
        loop=keyframes.loop,
        notes=(f"{len(keyframes.keys)} key poses, {keyframes.interpolation} in between",),
        skeleton=skeleton,
        file_angles={name: _peak(keyframes, name) for name in joints},
    )


def _turns(keyframes: Keyframes, joint: str, times: np.ndarray) -> np.ndarray:
    """Returns one joint's quaternions [F,4] wxyz."""
    keys = [key for key in keyframes.keys if joint in key.angles]
    if not keys:
        return np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    at = np.array([key.time for key in keys], float)
    angles = np.radians([np.atleast_1d(key.angles[joint]) for key in keys])
    axes = [_vector(axis) for axis in re.findall(r"-?[xyz]", keyframes.axes[joint])]
    if len(axes) == 1:
        at, angles = _around(keyframes, at, angles, np.zeros(1))
        turned = Rotation.from_rotvec(_between(keyframes, at, angles, times) * axes[0])
        return turned.as_quat(scalar_first=True)
    at, angles = _around(keyframes, at, angles, np.zeros(len(axes)))
    poses = Rotation.identity(len(at))
    for column, axis in enumerate(axes):
        poses = poses * Rotation.from_rotvec(angles[:, column, None] * axis)
    if len(at) == 1:
        return np.tile(poses.as_quat(scalar_first=True), (len(times), 1))
    path = Slerp(at, poses) if keyframes.interpolation == "linear" else RotationSpline(at, poses)
    return path(np.clip(times, at[0], at[-1])).as_quat(scalar_first=True)


def _positions(keyframes: Keyframes, times: np.ndarray) -> np.ndarray:
    keys = [key for key in keyframes.keys if key.position is not None]
    at = np.array([key.time for key in keys], float)
    values = np.array([key.position for key in keys], float)
    at, values = _around(keyframes, at, values, np.asarray(keyframes.travel, float))
    return _between(keyframes, at, values, times)


def _around(
    keyframes: Keyframes, at: np.ndarray, values: np.ndarray, travel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the keys of a loop with the cycles before and after it, else the keys as they are."""
    if not keyframes.loop:
        return at, values
    end = _end(keyframes)
    cycles = (-1.0, 0.0, 1.0)
    return (
        np.concatenate([at + cycle * end for cycle in cycles]),
        np.concatenate([values + cycle * travel for cycle in cycles]),
    )


def _between(
    keyframes: Keyframes, at: np.ndarray, values: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Returns values [F,k] between keys, held before the first and after the last."""
    if len(at) == 1:
        return np.tile(values, (len(times), 1))
    times = np.clip(times, at[0], at[-1])
    if keyframes.interpolation == "spline":
        return CubicSpline(at, values, bc_type="natural")(times)
    return np.stack([np.interp(times, at, column) for column in values.T], axis=1)


def _end(keyframes: Keyframes) -> float:
    given = keyframes.duration
    return float(keyframes.keys[-1].time if given is None else given)


def _peak(keyframes: Keyframes, joint: str) -> float:
    """Returns the largest angle written for a joint, in rad."""
    written = [np.abs(key.angles[joint]).max() for key in keyframes.keys if joint in key.angles]
    return float(np.radians(max(written, default=0.0)))


def _vector(axis: str) -> np.ndarray:
    return np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)


def _check(keyframes: Keyframes) -> None:
    what = f"keyframes '{keyframes.name}'"
    if keyframes.interpolation not in INTERPOLATIONS:
        raise unknown(f"interpolation of {what}", keyframes.interpolation, INTERPOLATIONS)
    for joint, axes in keyframes.axes.items():
        if not isinstance(axes, str) or not _AXES.fullmatch(axes):
            raise UserError(
                f"{what}: axes of {joint} are '{axes}': write one to three of x, y, z, each with an"
                " optional -, such as '-yxz'"
            )
    if not isinstance(keyframes.loop, bool):
        raise UserError(f"{what}: loop is {keyframes.loop}: choose true or false")
    _numbers(f"{what}: rate", keyframes.rate, 1)
    _numbers(f"{what}: travel", keyframes.travel, 3)
    if keyframes.duration is not None:
        _numbers(f"{what}: duration", keyframes.duration, 1)
    for index, key in enumerate(keyframes.keys):
        _check_key(f"{what}: pose {index}", key, keyframes.axes)
    times = np.array([key.time for key in keyframes.keys], float)
    if len(times) < 2 or times[0] != 0.0 or (np.diff(times) <= 0).any():
        raise UserError(f"{what}: times {times.tolist()} must begin with 0 and increase, 2 or more")
    if keyframes.keys[0].position is None:
        raise UserError(f"{what}: pose 0 has no root position")
    if keyframes.loop and (keyframes.duration is None or not keyframes.duration > times[-1]):
        raise UserError(
            f"{what}: duration {keyframes.duration} of a loop must be later than its last pose"
            f" ({times[-1]:g} s): it is when the first pose comes back"
        )
    if not keyframes.loop and keyframes.duration not in (None, times[-1]):
        raise UserError(f"{what}: duration is for loops; without one it is the last pose's time")
    if not 1.0 <= keyframes.rate <= 1000.0:
        raise UserError(f"{what}: rate {keyframes.rate} Hz: choose 1 to 1000")


def _check_key(what: str, key: Key, axes: Mapping[str, str]) -> None:
    _numbers(f"{what}: time", key.time, 1)
    if key.position is not None:
        _numbers(f"{what}: position", key.position, 3)
    for joint, angles in key.angles.items():
        if joint not in axes:
            raise unknown(f"joint in {what}", joint, tuple(axes))
        _numbers(f"{what}: {joint}", angles, len(axes[joint].replace("-", "")))


def _numbers(what: str, value: object, count: int) -> None:
    try:
        array = np.atleast_1d(np.asarray(value, float))
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise UserError(f"{what} is {value}: give {count} finite number{'s' * (count > 1)}")
