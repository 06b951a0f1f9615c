# SPDX-License-Identifier: Apache-2.0
"""Adaptive bounds: sizes that tighten while the skill succeeds and loosen while it fails.

SB section 6 names this as future work. One scale multiplies all sizes. It is one for all because
the bound that ends an episode is where a fault shows first, not where it lies: with a scale each,
just those bounds would open that are hard to keep, and with them the hard parts of a skill, which
the bounds are there to demand (SB section 5.2).
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills.errors import UserError
from jaxskills.learn.rollout import Fresh


@dataclasses.dataclass(frozen=True)
class AdaptiveBoundsConfig:
    """How the scale follows the mean time until an episode leaves its bounds."""

    enabled: bool = False
    target: float = 3.0  # s; while episodes last longer in the mean, the bounds tighten
    start: float = 1.0  # scale at the beginning
    low: float = 0.5  # smallest scale
    high: float = 2.0  # largest scale
    rate: float = 0.005  # of an update: by at most this share the scale changes
    memory: float = 0.9  # of the running average of how often episodes end, with each update


@struct.dataclass
class Adaptive:
    """What the sizes of the bounds are multiplied with, and why."""

    scale: jax.Array  # []
    failures: jax.Array  # [] per s, running average of how often an episode leaves its bounds


def init(config: AdaptiveBoundsConfig) -> Adaptive:
    """Returns the first scale; nothing is known yet, so episodes are taken to last the target."""
    return Adaptive(jnp.float32(config.start), jnp.float32(1.0 / config.target))


def update(
    config: AdaptiveBoundsConfig, adaptive: Adaptive, failures: jax.Array, seconds: float
) -> Adaptive:
    """Returns the scale after `failures []` in `seconds` of all environments together.

    With r failures where the target allows one, it changes by exp(rate (r - 1)), r at most 2, and
    stays within its limits. What ends at the time limit is no failure.
    """
    average = config.memory * adaptive.failures + (1.0 - config.memory) * failures / seconds
    error = jnp.minimum(config.target * average, 2.0) - 1.0
    scale = adaptive.scale * jnp.exp(config.rate * error)
    return Adaptive(jnp.clip(scale, config.low, config.high), average)


def under(adaptive: Adaptive | None, fresh: Fresh) -> Fresh:
    """Returns environments `[B]` with bounds of the present scale; None leaves them as they are."""
    if adaptive is None:
        return fresh
    scale = jnp.broadcast_to(adaptive.scale, fresh.state.phase.shape)
    return Fresh(fresh.state.replace(scale=scale), fresh.obs)


def validate(config: AdaptiveBoundsConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 0 < config.target <= 3600:
        raise UserError(f"adaptive_bounds.target is {config.target}: give 0 to 3600 s")
    if not 0 < config.low <= config.start <= config.high < 1000:
        raise UserError(
            f"adaptive_bounds.low, start, high are {config.low}, {config.start}, {config.high}:"
            " give 0 < low <= start <= high < 1000"
        )
    if not 0 <= config.rate <= 1:
        raise UserError(f"adaptive_bounds.rate is {config.rate}: give 0 to 1")
    if not 0 <= config.memory < 1:
        raise UserError(f"adaptive_bounds.memory is {config.memory}: give 0 <= memory < 1")
