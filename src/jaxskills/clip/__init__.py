# SPDX-License-Identifier: Apache-2.0
"""Motion clips by name or file: DeepMimic JSON, BVH, keyframe TOML and this library's own npz."""

import zipfile
from pathlib import Path

import numpy as np

from jaxskills import paths
from jaxskills.clip import bvh, deepmimic, keyframes
from jaxskills.clip.data import Clip, Skeleton, build, cut, once
from jaxskills.errors import UserError, unknown

__all__ = ["Clip", "Skeleton", "available", "build", "cut", "load", "once", "save"]

_PREFIX = "humanoid3d_"


def load(name: str | Path) -> Clip:
    """Returns the clip of a name (see `available`) or of a file, z up, in metres.

    Files: `.txt`, `.json` DeepMimic, `.bvh` (the `bvh` extra), `.toml` keyframes, `.npz` of `save`.

    Raises:
      UserError: unknown name, missing or broken file; the message names the frame and the column.
    """
    path = find(name)
    return _READERS[path.suffix.lower()](path)


def find(name: str | Path) -> Path:
    """Returns the file of a clip name, or the path itself.

    Raises:
      UserError: neither a known name nor a file of a known format.
    """
    path = Path(name)
    if path.suffix.lower() in _READERS:
        if path.is_dir():
            raise UserError(f"clip '{path}' is a folder: name a file in it")
        if not path.is_file():
            raise UserError(f"clip '{path}' does not exist")
        return path
    for suffix in (".toml", ".npz"):
        shipped = paths.data_dir() / "clips" / f"{name}{suffix}"
        if shipped.is_file():
            return shipped
    if path.is_file():
        raise UserError(f"clip '{path}' is of no known format: use one of {', '.join(_READERS)}")
    for folder in paths.deepmimic_dirs():
        for candidate in (folder / f"{_PREFIX}{name}.txt", folder / f"{name}.txt"):
            if candidate.is_file():
                return candidate
    raise unknown("clip", name, (*available(), "FILE.bvh", "FILE.txt"))


def available() -> list[str]:
    """Returns the names `load` knows: shipped clips, and DeepMimic's if they are installed."""
    shipped = paths.data_dir() / "clips"
    names = [path.stem for path in shipped.glob("*") if path.suffix in (".toml", ".npz")]
    try:
        folders = paths.deepmimic_dirs()
    except UserError:
        return sorted(names)
    for folder in folders:
        names += [path.stem.removeprefix(_PREFIX) for path in folder.glob(f"{_PREFIX}*.txt")]
        names += [f"walker/{path.stem}" for path in (folder / "walker").glob("*.txt")]
    return sorted(set(names))


def save(clip: Clip, path: str | Path) -> Path:
    """Writes the clip as npz, nothing lost, and returns the path written."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise UserError(f"clips are saved as .npz, not '{path}'")
    arrays = {key: getattr(clip, key) for key in ("times", "root_pos", "root_rot", "rotations")}
    if clip.skeleton is not None:
        arrays["parents"] = np.array(clip.skeleton.parents, np.int32)
        arrays["offsets"] = clip.skeleton.offsets
    np.savez_compressed(
        path,
        name=np.array(clip.name),
        loop=np.array(clip.loop),
        joints=np.array(clip.joints, str),
        notes=np.array(clip.notes, str),
        angle_joints=np.array(list(clip.file_angles), str),
        angle_peaks=np.array(list(clip.file_angles.values()), float),
        **arrays,
    )
    return path


def _read_npz(path: Path) -> Clip:
    try:
        with np.load(path, allow_pickle=False) as file:
            content = {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"clip '{path}' is not a sound npz file: {error}") from None
    needed = ("times", "joints", "root_pos", "root_rot", "rotations")
    missing = [key for key in needed if key not in content]
    if missing:
        raise UserError(f"clip '{path}' lacks {', '.join(missing)}: write it with clip.save")
    skeleton = None
    if "parents" in content and "offsets" in content:
        skeleton = Skeleton(tuple(map(int, content["parents"])), content["offsets"])
    peaks = content.get("angle_peaks", np.zeros(0))
    return build(
        str(path),
        str(content.get("name", path.stem)),
        content["times"],
        tuple(map(str, content["joints"])),
        content["root_pos"],
        content["root_rot"],
        content["rotations"],
        loop=bool(content.get("loop", False)),
        notes=tuple(map(str, content.get("notes", ()))),
        skeleton=skeleton,
        file_angles=dict(
            zip(map(str, content.get("angle_joints", ())), map(float, peaks), strict=True)
        ),
    )


_READERS = {
    ".txt": deepmimic.read,
    ".json": deepmimic.read,
    ".bvh": bvh.read,
    ".toml": keyframes.read,
    ".npz": _read_npz,
}
