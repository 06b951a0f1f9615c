# SPDX-License-Identifier: Apache-2.0
"""Where and with what a figure was measured, for the files that hold figures."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from jaxskills import physics

_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")


def describe(repository: Path) -> dict[str, Any]:
    """Returns device, default backend, processor, cores, versions and commit, JSON-ready.

    Args:
      repository: folder in the git checkout that the code was run from. `commit` is empty outside
        of one, and `clean` tells whether its `src/` is as committed.
    """
    return {
        "device": jax.devices()[0].device_kind,
        "backend": physics.default_backend(),
        "processor": _processor(),
        "cores": physics.usable_cores(),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in _PACKAGES},
        "commit": _git(repository, "rev-parse", "HEAD"),
        "clean": not _git(repository, "status", "--porcelain", "--", ":/src"),
    }


def _git(repository: Path, *words: str) -> str:
    command = ["git", "-C", str(repository), *words]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    except FileNotFoundError:  # no git on this machine
        return ""


def _processor() -> str:
    """Returns the name of the processor as Linux knows it, else as Python does."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
