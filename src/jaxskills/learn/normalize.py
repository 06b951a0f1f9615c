# SPDX-License-Identifier: Apache-2.0
"""Running mean and variance of observations."""

import jax
import jax.numpy as jnp
from flax import struct

_CLIP = 5.0  # standard deviations
_FLOOR = 1e-3  # least standard deviation, in the observation's own unit


@struct.dataclass
class Normalizer:
    """Statistics of everything seen so far."""

    count: jax.Array  # []
    mean: jax.Array  # [O]
    var: jax.Array  # [O]


def init(size: int) -> Normalizer:
    """Returns empty statistics, which leave an observation as it is."""
    return Normalizer(jnp.zeros(()), jnp.zeros(size), jnp.ones(size))


def update(state: Normalizer, batch: jax.Array) -> Normalizer:
    """Returns the statistics with `batch [M, O]` taken in (Chan et al. 1979)."""
    size = batch.shape[0]
    mean, var = jnp.mean(batch, axis=0), jnp.var(batch, axis=0)
    count = state.count + size
    delta = mean - state.mean
    share = size / count
    new_var = (1.0 - share) * state.var + share * var + share * (1.0 - share) * delta**2
    return Normalizer(count, state.mean + share * delta, new_var)


def apply(state: Normalizer, obs: jax.Array) -> jax.Array:
    """Returns `obs [..., O]` in standard deviations from the mean, clipped."""
    deviation = jnp.maximum(jnp.sqrt(state.var), _FLOOR)
    return jnp.clip((obs - state.mean) / deviation, -_CLIP, _CLIP)


def pin(state: Normalizer, place: int, mean: jax.Array, deviation: jax.Array) -> Normalizer:
    """Returns the statistics with those of some entries, from `place` on, as given.

    For what hardly varies at first and will later: seen through its early deviation it would jump.
    """
    rows = slice(place, place + mean.shape[0])
    return Normalizer(
        state.count, state.mean.at[rows].set(mean), state.var.at[rows].set(deviation**2)
    )
