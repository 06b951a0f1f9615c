# SPDX-License-Identifier: Apache-2.0
"""An OpenGL context without a window: EGL where it works, else OSMesa.

A failed attempt leaves PyOpenGL bound to that library, so each is tried in a process of its own.
MuJoCo reads `MUJOCO_GL` when it is imported, which is long before anything is drawn; its context
classes are therefore loaded here by name.
"""

import functools
import importlib
import os
import subprocess
import sys
from typing import Any

from jaxskills.errors import UserError, unknown

VARIABLE = "MUJOCO_GL"

# What `MUJOCO_GL` may say -> the module of `mujoco` that has the context class.
_MODULES = {"egl": "egl", "osmesa": "osmesa", "glfw": "glfw", "glx": "glfw", "wgl": "glfw"} | (
    {"cgl": "cgl"} if sys.platform == "darwin" else {}
)
_UNDECIDED = ("", "enable", "enabled", "on", "true", "1")
_OFF = ("disable", "disabled", "off", "false", "0")

# In order of preference, where `MUJOCO_GL` does not decide.
_CANDIDATES = {"linux": ("egl", "osmesa"), "darwin": ("cgl", "glfw")}.get(sys.platform, ("glfw",))
_INSTALL = "apt-get install libegl1 libgl1 (or libosmesa6)"

_PROBE = """
import mujoco
from mujoco.{module} import GLContext
context = GLContext(8, 8)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100).free()
context.free()
"""
_PROBE_SECONDS = 60.0


def context(width: int, height: int) -> Any:
    """Returns a current context; `free()` it when done.

    Args:
      width: largest image in pixels.
      height: likewise.

    Raises:
      UserError: nothing on this machine can draw; the message names the package to install.
    """
    current = importlib.import_module(f"mujoco.{backend()}").GLContext(width, height)
    current.make_current()
    return current


def backend() -> str:
    """Returns the module of `mujoco` that draws here: `egl`, `osmesa`, `glfw` or `cgl`.

    `MUJOCO_GL` decides if it is set. The first answer costs up to two short processes.

    Raises:
      UserError: `MUJOCO_GL` is unknown, switches drawing off or does not work, or nothing does.
    """
    asked = os.environ.get(VARIABLE, "").lower().strip()
    if asked in _OFF:
        raise UserError(f"{VARIABLE}='{asked}' switches rendering off: unset it")
    if asked in _UNDECIDED:
        for module in _CANDIDATES:
            if _works(module):
                return module
        raise UserError(f"cannot render: no {' or '.join(_CANDIDATES)} here: run {_INSTALL}")
    if asked not in _MODULES:
        raise unknown(VARIABLE, asked, _MODULES)
    if not _works(_MODULES[asked]):
        raise UserError(f"{VARIABLE}='{asked}' does not work here: unset it, or run {_INSTALL}")
    return _MODULES[asked]


@functools.cache
def _works(module: str) -> bool:
    command = [sys.executable, "-c", _PROBE.format(module=module)]
    environment = os.environ | {VARIABLE: module}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, timeout=_PROBE_SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0
