# SPDX-License-Identifier: Apache-2.0
"""Where episodes begin: on the reference, more often where they go badly (SB section 4.3)."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills.errors import UserError


@dataclasses.dataclass(frozen=True)
class StartsConfig:
    """Importance sampling over segments of the reference; `uniform` 1 switches it off."""

    segments: int = 10
    uniform: float = 0.2  # u of SB eq. 11, the share that stays uniform
    memory: float = 0.9  # of the running average of a segment's return, for each start seen there
    # s after which an episode is cut off for a new start, in the mean; inf: never. Otherwise, once
    # most episodes last, those that fail at once have next to no share in what is learnt from.
    renewal: float = 5.0


@struct.dataclass
class Starts:
    """What is known of the S segments."""

    returns: jax.Array  # [S] running average of the estimated return of episodes begun there
    seen: jax.Array  # [S] bool, an episode began in this segment at all


def init(config: StartsConfig) -> Starts:
    """Returns segments of which nothing is known yet."""
    return Starts(jnp.zeros(config.segments), jnp.zeros(config.segments, bool))


def probabilities(starts: Starts, uniform: float) -> jax.Array:
    """Returns how likely an episode begins in each segment, `[S]` (SB eq. 11).

    p(k) = (1 - u) softmax(-w_k / v) + u / S, v = (max w - min w) / 3. Segments not seen yet count
    as average.
    """
    count = starts.returns.shape[0]
    known = jnp.maximum(jnp.sum(starts.seen), 1)
    mean = jnp.sum(jnp.where(starts.seen, starts.returns, 0.0)) / known
    returns = jnp.where(starts.seen, starts.returns, mean)
    spread = (jnp.max(returns) - jnp.min(returns)) / 3.0
    level = (returns - jnp.min(returns)) / jnp.where(spread > 0.0, spread, 1.0)
    return (1.0 - uniform) * jax.nn.softmax(-level) + uniform / count


def sample(
    config: StartsConfig, starts: Starts, key: jax.Array, count: int, length: float
) -> jax.Array:
    """Returns `[count]` phases in [0, length) (control frames). The key is consumed."""
    segment_key, place_key = jax.random.split(key)
    segment = sample_segments(config, starts, segment_key, count)
    place = jax.random.uniform(place_key, (count,))
    return (segment + place) / config.segments * length


def sample_segments(config: StartsConfig, starts: Starts, key: jax.Array, count: int) -> jax.Array:
    """Returns `[count]` int32 segments in which episodes shall begin. The key is consumed."""
    chances = jnp.log(probabilities(starts, config.uniform))
    return jax.random.categorical(key, chances, shape=(count,))


def update(
    config: StartsConfig,
    starts: Starts,
    phase: jax.Array,
    returns: jax.Array,
    first: jax.Array,
    length: float,
) -> Starts:
    """Returns the segments with what the episodes tell that were begun.

    Only the states that episodes begin with count. On the way through a segment a controller that
    has been on its way for a while is safe where one that begins there may fall.

    Args:
      config: how.
      starts: before.
      phase: `[M]` control frames of the visited states.
      returns: `[M]` estimated from there.
      first: `[M]` bool, the state is the first of its episode.
      length: control frames in a cycle.
    """
    place = jnp.floor((phase % length) / length * config.segments).astype(jnp.int32)
    member = jax.nn.one_hot(jnp.clip(place, 0, config.segments - 1), config.segments)
    member = member * first[:, None]
    count = jnp.sum(member, axis=0)
    mean = returns @ member / jnp.maximum(count, 1.0)
    kept = config.memory**count
    blended = kept * starts.returns + (1.0 - kept) * mean
    fresh = jnp.where(starts.seen, blended, mean)
    return Starts(jnp.where(count > 0, fresh, starts.returns), starts.seen | (count > 0))


def validate(config: StartsConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if config.segments < 1:
        raise UserError(f"starts.segments is {config.segments}: give 1 or more")
    if not config.renewal > 0:
        raise UserError(f"starts.renewal is {config.renewal}: give a positive number of s, or inf")
    for name in ("uniform", "memory"):
        if not 0 <= getattr(config, name) <= 1:
            raise UserError(f"starts.{name} is {getattr(config, name)}: give 0 to 1")
