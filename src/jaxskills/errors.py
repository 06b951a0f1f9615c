# SPDX-License-Identifier: Apache-2.0
"""The one error a person is meant to read: what is wrong, its value, what is allowed."""

from collections.abc import Iterable


class UserError(ValueError):
    """Bad input. The message is one line; the command line prints it and exits with 2."""


def unknown(kind: str, value: object, allowed: Iterable[str]) -> UserError:
    """Returns the error for a name that is not one of `allowed`: `unknown skill 'wlak': ...`."""
    return UserError(f"unknown {kind} '{value}': choose one of {', '.join(allowed)}")
