# SPDX-License-Identifier: Apache-2.0
"""Physics-based motor skills from one short motion clip, in JAX."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxskills.errors import UserError as UserError

__version__ = "0.1.0"

# Public name -> its module. A name is imported on first use, so that `jaxskills --help` and a
# mistyped command need not wait for JAX.
_MODULE = {
    "UserError": "errors",
}

__all__ = ["__version__", *_MODULE]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'jaxskills' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"jaxskills.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
