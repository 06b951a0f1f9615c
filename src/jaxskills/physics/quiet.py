# SPDX-License-Identifier: Apache-2.0
"""Keeps MuJoCo's warnings off the console and out of MUJOCO_LOG.TXT.

With thousands of environments exploring, warnings come by the thousand, from threads without the
GIL, and the default handler appends each to a file in the working directory. What matters in them,
divergence, is reported by `SimState.diverged`. The setting is MuJoCo's own and holds for the
process; a handler installed with `mujoco.set_mju_user_warning` still gets every message.
"""

import ctypes
import functools

from mujoco import _functions


class _LogConfig(ctypes.Structure):
    """`mjLogConfig` of mujoco/mjtype.h."""

    _fields_ = [
        ("to_console", ctypes.c_bool),
        ("to_file", ctypes.c_bool),
        ("file", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    ]


@functools.cache
def silence() -> bool:
    """Turns MuJoCo's own log off, once; returns false where the library does not offer that."""
    try:
        # Symbols are looked up in the libraries that the extension module is linked to as well,
        # so the name and the place of MuJoCo's own library do not matter.
        library = ctypes.CDLL(_functions.__file__)
        library.mju_getLogConfig.restype = _LogConfig
        library.mju_setLogConfig.argtypes = [_LogConfig]
        library.mju_setLogConfig.restype = None
        config = library.mju_getLogConfig()
    except (AttributeError, OSError):
        return False
    if config.file != b"MUJOCO_LOG.TXT":  # laid out otherwise, or set by the user: leave it alone
        return False
    config.to_console = config.to_file = False
    library.mju_setLogConfig(config)
    return True
