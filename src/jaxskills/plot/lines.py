# SPDX-License-Identifier: Apache-2.0
"""The lines of metrics.jsonl, as all plots read them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxskills.errors import UserError


def check(metrics: Sequence[Mapping[str, Any]], required: Sequence[str]) -> None:
    """Checks the lines of metrics.jsonl.

    Raises:
      UserError: there are none, or one lacks a `required` entry.
    """
    if not metrics:
        raise UserError("there is nothing to plot: metrics.jsonl has no lines yet")
    for number, line in enumerate(metrics, 1):
        missing = [key for key in required if key not in line]
        if missing:
            raise UserError(f"line {number} of metrics.jsonl lacks {', '.join(missing)}")


def column(metrics: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
    """Returns an entry of every line, NaN where a line lacks it."""
    return np.array([line.get(key, np.nan) for line in metrics], float)
