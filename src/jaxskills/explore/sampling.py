# SPDX-License-Identifier: Apache-2.0
"""Task parameters drawn by region: where elites are dense, and just around (FS section 6).

The density of elites divides the task space, a box from 0 to 1 in each of P parameters. Regions
have no formula, so points are drawn all over the box and sorted by their density. Early on regions
are tiny and lie around the reference; so some of the points come from boxes close to it, and each
has the weight that makes the whole uniform again.
"""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills.errors import UserError

Function = Callable[[jax.Array], jax.Array]
_Chains = tuple[jax.Array, jax.Array]  # [chains, P] and [chains]

SURROUNDING, VISITED, ELSEWHERE = 0, 1, 2  # regions

# Half the width of the boxes around the reference; 1 is all of the task space.
_REACH = (1.0, 1 / 4, 1 / 8, 1 / 16)
_CLOSE = 8  # one in so many points, in each box but the first


@dataclasses.dataclass(frozen=True)
class SamplingConfig:
    """What makes a region, and how parameters are drawn there."""

    visited: float = 0.8  # D: where the density is higher is heavily visited
    surrounding: float = 0.2  # D': from here to D lie the surroundings
    candidates: int = 4096  # points of which those in a region are taken
    preference: float = 10.0  # k of FS eq. 17, for low marginal values
    # A parameter is up to so many times as likely as one of mean value, or down to as many times
    # less. Without a limit, where a policy fails is a thousand times as likely as the rest, and
    # the rest, no longer practised, is unlearnt.
    limit: float = 3.0
    pool: int = 1000  # task parameters that MCMC draws at a time
    chains: int = 50  # starting points
    thin: int = 5  # steps of a chain from one that is kept to the next
    step: float = 0.2  # largest standard deviation of a step; each has its own, down to a tenth


@struct.dataclass
class Survey:
    """N points of the task space."""

    a: jax.Array  # [N, P]
    density: jax.Array  # [N] of elites
    weight: jax.Array  # [N] share of the task space that a point stands for; they add up to 1


def region(config: SamplingConfig, density: jax.Array) -> jax.Array:
    """Returns the region `[...]` int32 for a density of elites `[...]`."""
    outside = jnp.where(density > config.surrounding, SURROUNDING, ELSEWHERE)
    return jnp.where(density > config.visited, VISITED, outside)


def survey(
    config: SamplingConfig, density: Function, reference: jax.Array, key: jax.Array
) -> Survey:
    """Returns points all over the task space, closer together around the reference.

    Args:
      config: how many.
      density: of elites, `[P] -> []`.
      reference: `[P]` task parameters of the reference motion.
      key: consumed.
    """
    close = config.candidates // _CLOSE
    counts = np.array([config.candidates - 3 * close, close, close, close])
    reference = jnp.clip(reference, 0.0, 1.0)
    low, high = (jnp.clip(reference + s * np.array(_REACH)[:, None], 0.0, 1.0) for s in (-1, 1))
    box = np.repeat(np.arange(4), counts)
    share = jax.random.uniform(key, (config.candidates, reference.shape[0]))
    a = jnp.clip(low[box] + share * (high - low)[box], low[box], high[box])
    inside = ((a[:, None] >= low) & (a[:, None] <= high)).all(-1)
    crowd = inside @ (counts / jnp.maximum(jnp.prod(high - low, axis=-1), 1e-20))
    return Survey(a, jax.vmap(density)(a), 1.0 / crowd / jnp.sum(1.0 / crowd))


def explored(config: SamplingConfig, points: Survey) -> jax.Array:
    """Returns the heavily visited share `[]` of the task space (FS table 1: ER)."""
    return jnp.sum(jnp.where(region(config, points.density) == VISITED, points.weight, 0.0))


def mean(
    config: SamplingConfig, points: Survey, value: Function, reference: jax.Array
) -> jax.Array:
    """Returns the mean `[]` over the heavily visited region of `value`, `[..., P] -> [...]`.

    Where nothing is visited it is that of the reference.
    """
    weight = jnp.where(region(config, points.density) == VISITED, points.weight, 0.0)
    total = jnp.sum(weight)
    average = weight @ value(points.a) / jnp.maximum(total, 1e-20)
    return jnp.where(total > 0, average, value(reference))


def surrounding(
    config: SamplingConfig, points: Survey, reference: jax.Array, key: jax.Array, count: int
) -> jax.Array:
    """Returns `[count, P]`, uniform over the surroundings of the heavily visited region.

    Without surroundings all is explored, and they are uniform over the heavily visited region;
    without that either, they are the reference. The key is consumed.
    """
    where = region(config, points.density)
    around = where == SURROUNDING
    member = jnp.where(around.any(), around, where == VISITED)
    return _chosen(points, member, points.weight, reference, key, count)


def mcmc(
    config: SamplingConfig,
    density: Function,
    value: Function,
    reference: jax.Array,
    points: Survey,
    key: jax.Array,
) -> jax.Array:
    """Returns `[pool, P]` of the heavily visited region, more where the value is low (FS eq. 17).

    p(a) = exp(-k (V(a) - mu) / mu), mu the mean of V over the region, from 1 / limit to the limit.
    A chain each from many starting points (Won and Lee 2019), by Metropolis' rule. Parts of the
    region with a gap between them are beyond a chain's reach, so the starting points are drawn by p
    already. Where nothing is visited all are the reference.

    Args:
      config: how.
      density: of elites, `[P] -> []`.
      value: V, the marginal value, `[..., P] -> [...]`.
      reference: `[P]` task parameters of the reference motion.
      points: a survey with this density.
      key: consumed.
    """
    start_key, walk_key = jax.random.split(key)
    member = region(config, points.density) == VISITED
    worth, mu = value(points.a), mean(config, points, value, reference)
    # FS eq. 17 takes values to be positive. Should mu come near 0 or below, p keeps a finite slope.
    share = jnp.where(member, points.weight, 0.0) / jnp.maximum(
        jnp.sum(points.weight * member), 1e-20
    )
    spread = jnp.sqrt(share @ (worth - mu) ** 2)
    slope = config.preference / jnp.maximum(jnp.maximum(jnp.abs(mu), 0.1 * spread), 1e-6)

    def preferred(worth: jax.Array) -> jax.Array:
        most = math.log(config.limit)
        return jnp.clip(-slope * (worth - mu), -most, most)

    level = jnp.where(member, preferred(worth), -jnp.inf)
    weight = points.weight * jnp.exp(level - jnp.max(level, initial=-1e30))
    start = _chosen(points, member, weight, reference, start_key, config.chains)

    def log_p(a: jax.Array) -> jax.Array:
        inside = region(config, jax.vmap(density)(a)) == VISITED
        return jnp.where(inside, preferred(value(a)), -jnp.inf)

    return _walk(config, log_p, start, walk_key)


def _walk(config: SamplingConfig, log_p: Function, start: jax.Array, key: jax.Array) -> jax.Array:
    """Returns `[pool, P]` of Metropolis chains from `start [chains, P]`; `log_p` takes all at once.

    Steps are Gaussian and reflected at the faces of the box. Their size is drawn anew for each,
    since regions grow from the radius of one elite to the whole box.
    """
    rounds = -(-config.pool // len(start))
    shape = (rounds, config.thin, *start.shape)
    size_key, step_key, accept_key = jax.random.split(key, 3)
    size = config.step * 0.1 ** jax.random.uniform(size_key, (*shape[:-1], 1))
    steps = size * jax.random.normal(step_key, shape)
    chances = jnp.log(jax.random.uniform(accept_key, shape[:-1]))

    def move(state: _Chains, given: _Chains) -> tuple[_Chains, None]:
        (a, level), (step, chance) = state, given
        trial = reflected(a + step)
        trial_level = log_p(trial)
        taken = chance < trial_level - level
        return (jnp.where(taken[:, None], trial, a), jnp.where(taken, trial_level, level)), None

    def kept(state: _Chains, given: _Chains) -> tuple[_Chains, jax.Array]:
        state, _ = jax.lax.scan(move, state, given)
        return state, state[0]

    _, a = jax.lax.scan(kept, (start, log_p(start)), (steps, chances))
    return a.reshape(-1, a.shape[-1])[: config.pool]


def reflected(a: jax.Array) -> jax.Array:
    """Returns points brought into the box from 0 to 1 by reflection at its faces."""
    return 1.0 - jnp.abs(1.0 - a % 2.0)


def _chosen(
    points: Survey,
    member: jax.Array,
    weight: jax.Array,
    reference: jax.Array,
    key: jax.Array,
    count: int,
) -> jax.Array:
    """Returns `[count, P]` of the member points with chances as their weights, or the reference.

    Drawn evenly spaced along the running sum of the weights, so no point is drawn twice that has
    less than 1 / count of them. Any part of the result is a fair sample too.
    """
    edges = jnp.cumsum(jnp.where(member, weight, 0.0))
    place = (jnp.arange(count) / count + jax.random.uniform(key)) % 1.0 * edges[-1]
    rows = jnp.minimum(jnp.searchsorted(edges, place, side="right"), len(edges) - 1)
    # The sum is rounded, so it may rise at a point without weight: back to the last member.
    rank = jnp.cumsum(member)
    rows = jnp.searchsorted(rank, jnp.maximum(rank[rows], 1))
    return jnp.where(rank[-1] > 0, points.a[jnp.minimum(rows, len(edges) - 1)], reference)


def validate(config: SamplingConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 0 <= config.surrounding < config.visited < 1000:
        raise UserError(
            f"sampling.surrounding, visited are {config.surrounding}, {config.visited}:"
            " give 0 <= surrounding < visited < 1000"
        )
    if not 8 <= config.candidates <= 1_000_000:
        raise UserError(f"sampling.candidates is {config.candidates}: give 8 to 1000000")
    if not 0 <= config.preference < 1000:
        raise UserError(f"sampling.preference is {config.preference}: give 0 to 1000")
    if not 1 <= config.limit < math.inf:
        raise UserError(f"sampling.limit is {config.limit}: give a factor of 1 or more")
    for name in ("pool", "chains", "thin"):
        if getattr(config, name) < 1:
            raise UserError(f"sampling.{name} is {getattr(config, name)}: give 1 or more")
    if not 0 < config.step <= 1:
        raise UserError(f"sampling.step is {config.step}: give 0 < step <= 1")
