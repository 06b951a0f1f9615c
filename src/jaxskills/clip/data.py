# SPDX-License-Identifier: Apache-2.0
"""What a motion clip is, and the one place where a clip's numbers are checked and tidied."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from jaxskills.errors import UserError

# Unit quaternions further off than this are worth a note (files round to 3-6 digits).
_NORM_TOLERANCE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Skeleton:
    """The skeleton a clip was made on, at the clip's zero pose. J joints as in `Clip.joints`."""

    parents: tuple[int, ...]  # [J] index of the parent joint, -1 for the root
    offsets: np.ndarray  # [J,3] m, from the parent joint, x forward, y left, z up

    def positions(self) -> np.ndarray:
        """Returns the joints [J,3] in m, relative to the root, at the zero pose."""
        placed = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents):
            placed[joint] = self.offsets[joint] + (placed[parent] if parent >= 0 else 0.0)
        return placed


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """A motion of F frames and J joints, free of any file format. Host side, float64."""

    name: str
    times: np.ndarray  # [F] s, increasing, starts at 0
    joints: tuple[str, ...]  # [J] source names, without the root
    root_pos: np.ndarray  # [F,3] m, z up
    root_rot: np.ndarray  # [F,4] wxyz, world
    rotations: np.ndarray  # [F,J,4] wxyz, child to parent; all frames x forward, y left, z up
    loop: bool  # the motion is one cycle and goes on from its start
    notes: tuple[str, ...] = ()  # what the loader absorbed, for people
    skeleton: Skeleton | None = None  # None: unknown; parents then follow the character's
    file_angles: Mapping[str, float] = dataclasses.field(default_factory=dict)
    # ^ largest angle in rad that the file writes as a plain angle, by joint; tells wrong units

    @property
    def duration(self) -> float:
        """Length in s."""
        return float(self.times[-1])

    @property
    def rate(self) -> float:
        """Frames per second, from the median step."""
        return float(1.0 / np.median(np.diff(self.times)))


def build(
    source: str,
    name: str,
    times: np.ndarray,
    joints: tuple[str, ...],
    root_pos: np.ndarray,
    root_rot: np.ndarray,
    rotations: np.ndarray,
    *,
    loop: bool,
    notes: tuple[str, ...] = (),
    skeleton: Skeleton | None = None,
    file_angles: Mapping[str, float] | None = None,
) -> Clip:
    """Returns the clip, checked, its quaternions at unit norm and continuous in sign.

    Args:
      source: how messages call the clip, such as its path.
      name: see `Clip`, as for all other arguments.

    Raises:
      UserError: too few frames, shapes that disagree, NaN, times that do not increase, a zero
        quaternion.
    """
    names = ("root", *joints)
    times, root_pos = np.asarray(times, float), np.asarray(root_pos, float)
    root_rot, rotations = np.asarray(root_rot, float), np.asarray(rotations, float)
    frames, count = len(times), len(joints)
    if (root_pos.shape, root_rot.shape) != ((frames, 3), (frames, 4)) or (
        rotations.shape != (frames, count, 4)
    ):
        raise UserError(
            f"clip '{source}': {frames} times and {count} joints go with root_pos"
            f" {list(root_pos.shape)}, root_rot {list(root_rot.shape)}, rotations"
            f" {list(rotations.shape)}: expected [{frames}, 3], [{frames}, 4] and"
            f" [{frames}, {count}, 4]"
        )
    quats = np.concatenate([root_rot[:, None], rotations], axis=1)
    _check(source, times, root_pos, quats, names)
    norms = np.linalg.norm(quats, axis=-1)
    quats = quats / norms[..., None]
    dots = np.sum(quats[1:] * quats[:-1], axis=-1)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    quats[1:] *= signs[..., None]
    quats *= np.where(quats[:1, :, :1] < 0, -1.0, 1.0)
    return Clip(
        name=name,
        times=times - times[0],
        joints=tuple(joints),
        root_pos=root_pos,
        root_rot=quats[:, 0],
        rotations=quats[:, 1:],
        loop=loop,
        notes=(*notes, *_absorbed(times, norms, dots)),
        skeleton=skeleton,
        file_angles=dict(file_angles or {}),
    )


def cut(clip: Clip, start: float, end: float | None) -> Clip:
    """Returns the part of a clip between two times in s, to the frame; a part does not loop.

    Raises:
      UserError: fewer than two frames are left.
    """
    if start == 0.0 and end is None:
        return clip
    end = clip.duration if end is None else end
    kept = (clip.times >= start - 1e-6) & (clip.times <= end + 1e-6)
    if kept.sum() < 2:
        raise UserError(
            f"motion.start {start:g} to motion.end {end:g}: clip '{clip.name}' has"
            f" {kept.sum()} frames there, it is {clip.duration:.2f} s long"
        )
    times = clip.times[kept] - clip.times[kept][0]
    root = {"root_pos": clip.root_pos[kept], "root_rot": clip.root_rot[kept]}
    return dataclasses.replace(
        clip, times=times, rotations=clip.rotations[kept], loop=False, **root
    )


def once(clip: Clip) -> Clip:
    """Returns a clip that does not loop: one that did without its last frame, where it starts anew.

    It looks much like the first one, so clips tend to have a jump there.
    """
    return cut(clip, 0.0, float(clip.times[-2])) if clip.loop else clip


def _check(
    source: str,
    times: np.ndarray,
    root_pos: np.ndarray,
    quats: np.ndarray,
    names: tuple[str, ...],
) -> None:
    if len(times) < 2:
        raise UserError(f"clip '{source}' has {len(times)} frame(s): at least 2 are needed")
    if len(set(names)) != len(names):
        twice = sorted({n for n in names if names.count(n) > 1})
        raise UserError(f"clip '{source}': joint '{twice[0]}' is listed twice: names must differ")
    for what, array in (("time", times), ("root position", root_pos)):
        if not np.isfinite(array).all():
            frame = int(np.argwhere(~np.isfinite(array))[0][0])
            raise UserError(f"clip '{source}': frame {frame}: {what} is not a finite number")
    norms = np.linalg.norm(quats, axis=-1)
    for bad, what in ((~np.isfinite(norms), "not finite"), (norms < 1e-6, "zero")):
        if bad.any():
            frame, joint = np.argwhere(bad)[0]
            raise UserError(
                f"clip '{source}': frame {frame}: the quaternion of {names[joint]} is {what}"
            )
    steps = np.diff(times)
    if (steps <= 0).any():
        frame = int(np.argmax(steps <= 0))
        raise UserError(
            f"clip '{source}': frame {frame} lasts {steps[frame]:g} s: durations must be > 0"
        )


def _absorbed(times: np.ndarray, norms: np.ndarray, dots: np.ndarray) -> tuple[str, ...]:
    notes = []
    off = np.abs(norms - 1.0)
    if (off > _NORM_TOLERANCE).any():
        notes.append(
            f"{int((off > _NORM_TOLERANCE).sum())} quaternions normalised"
            f" (worst norm error {off.max():.2g})"
        )
    if (dots < 0).any():
        notes.append(f"{int((dots < 0).sum())} sign flips between neighbouring quaternions undone")
    steps = np.diff(times)
    middle = np.median(steps)
    odd = np.abs(steps - middle) > 0.01 * middle
    if odd.any():
        worst = int(np.argmax(np.abs(steps - middle)))
        notes.append(
            f"{int(odd.sum())} of {len(steps)} frames last longer or shorter than"
            f" {middle:.4g} s (frame {worst}: {steps[worst]:.4g} s)"
        )
    return tuple(notes)
