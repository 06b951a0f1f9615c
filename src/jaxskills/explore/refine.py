# SPDX-License-Identifier: Apache-2.0
"""Finer physics for the last part of a training.

A controller that learnt with large time steps lives off their errors, where a skill is delicate: it
stands at 120 Hz and falls at 600 Hz. Once it stands, a little training at twice the rate mends
that, for a fraction of what finer steps would have cost from the beginning.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills.errors import UserError


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """When physics steps become finer, and how fine."""

    survival: float = 15.0  # s between failures in the mean, from which on they do; inf: never
    factor: int = 2  # times as many physics steps
    memory: float = 0.95  # of the running average of how often episodes fail, with each update


@struct.dataclass
class Refinement:
    """How far it is."""

    failures: jax.Array  # [] per s, running average
    fine: jax.Array  # [] bool, physics steps are finer from now on


def init() -> Refinement:
    """Returns the beginning: nothing is known, so episodes are taken to fail soon."""
    return Refinement(jnp.float32(2.0), jnp.bool_(False))


def update(
    config: RefineConfig, refinement: Refinement, failures: jax.Array, seconds: float
) -> Refinement:
    """Returns it after `failures []` in `seconds` of all environments together."""
    average = config.memory * refinement.failures + (1.0 - config.memory) * failures / seconds
    return Refinement(average, refinement.fine | (average * config.survival < 1.0))


def validate(config: RefineConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not config.survival > 0:
        raise UserError(f"refine.survival is {config.survival}: give a positive number, or inf")
    if not 1 <= config.factor <= 20:
        raise UserError(f"refine.factor is {config.factor}: give 1 to 20")
    if not 0 <= config.memory < 1:
        raise UserError(f"refine.memory is {config.memory}: give 0 <= memory < 1")
