# SPDX-License-Identifier: Apache-2.0
# MuJoCo's compiled half has no type stubs: whatever it holds is of any type.
from typing import Any

def __getattr__(name: str) -> Any: ...
