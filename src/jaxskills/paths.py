# SPDX-License-Identifier: Apache-2.0
"""Where shipped files lie, in a checkout and in an installed wheel, and where clips are found."""

import importlib.util
import os
from pathlib import Path

from jaxskills.errors import UserError

_PACKAGE = Path(__file__).resolve().parent

CLIP_DIR_VARIABLE = "JAXSKILLS_CLIP_DIR"


def shipped(folder: str) -> Path:
    """Returns the folder of shipped files: inside the wheel, or beside `src/` in a checkout."""
    in_wheel = _PACKAGE / folder
    return in_wheel if in_wheel.is_dir() else _PACKAGE.parents[1] / folder


def data_dir() -> Path:
    """Returns the folder with `characters/` and `clips/`."""
    return shipped("data")


def deepmimic_dirs() -> list[Path]:
    """Returns the folders of DeepMimic motion files (`humanoid3d_*.txt`), the first to win first.

    The user's own, named by `JAXSKILLS_CLIP_DIR`, then that of the `pybullet_data` package of the
    `clips` extra. Only its files are read: the simulator is never imported.

    Raises:
      UserError: neither is there; the message names the extra and the variable.
    """
    named, folders = os.environ.get(CLIP_DIR_VARIABLE), []
    if named:
        if not Path(named).is_dir():
            raise UserError(f"{CLIP_DIR_VARIABLE}='{named}' is not a folder: name one with clips")
        folders.append(Path(named))
    spec = importlib.util.find_spec("pybullet_data")
    if spec is not None and spec.origin is not None:
        folders.append(Path(spec.origin).parent / "data" / "motions")
    if not folders:
        raise UserError(
            "the DeepMimic motion files are not installed: run pip install 'jaxskills[clips]',"
            f" or set {CLIP_DIR_VARIABLE} to a folder that holds them"
        )
    return folders


def write_whole(path: Path, text: str) -> None:
    """Writes a file so that it is the old one or the new one, whatever the disk does meanwhile.

    Raises:
      OSError: the disk is full or the folder cannot be written.
    """
    beside = path.with_name(path.name + ".new")
    try:
        beside.write_text(text)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
