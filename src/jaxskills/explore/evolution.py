# SPDX-License-Identifier: Apache-2.0
"""Initial state evolution (SB 4.3.2): where poor references lie outside of what is feasible, starts
drift to states that were visited and went well.

Each segment of the reference holds M elites. They begin on the reference, and after each update are
drawn anew, without replacement, from themselves and all states visited in their segment, with
chances exp(3 (w - max w) / (max w - min w)) of the estimated return w. SB eq. 12 has the opposite
sign, which would keep the worst; the authors' own code keeps the best, and so does this.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import pose
from jaxskills.errors import UserError
from jaxskills.motion import Motion, sample


@dataclasses.dataclass(frozen=True)
class EvolutionConfig:
    """How starts evolve; the numbers are those of the authors' code."""

    enabled: bool = False  # SB: for poor references and very hard skills
    elites: int = 200  # of each segment
    greed: float = 3.0  # how much better states are preferred
    decay: float = 0.95  # of an old elite's return with each update, since the policy has moved on
    noise: float = 0.05  # rad, on the joints of a start


@struct.dataclass
class Elites:
    """M states in each of S segments."""

    qpos: jax.Array  # [S, M, nq]
    qvel: jax.Array  # [S, M, nv]
    phase: jax.Array  # [S, M] control frames, within the first cycle
    value: jax.Array  # [S, M] estimated return


@struct.dataclass
class Visited:
    """N states that a rollout went through, moved into the first cycle (`motion.fold`)."""

    qpos: jax.Array  # [N, nq]
    qvel: jax.Array  # [N, nv]
    phase: jax.Array  # [N]
    value: jax.Array  # [N]


def init(config: EvolutionConfig, layout: pose.Layout, motion: Motion, segments: int) -> Elites:
    """Returns elites evenly spread over the reference, of value 0."""
    phase = jnp.arange(segments * config.elites) / (segments * config.elites) * motion.length
    qpos, qvel = jax.vmap(lambda one: sample(layout, motion, one))(phase)
    shape = (segments, config.elites)
    arrays = [x.reshape(*shape, *x.shape[1:]) for x in (qpos, qvel, phase)]
    return Elites(*arrays, value=jnp.zeros(shape))


def draw(
    config: EvolutionConfig, layout: pose.Layout, elites: Elites, key: jax.Array, segment: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns phase `[B]`, qpos `[B, nq]` and qvel `[B, nv]` of elites of `segment [B]`.

    The joints get noise; the root and objects do not. The key is consumed.
    """
    row_key, noise_key = jax.random.split(key)
    row = jax.random.randint(row_key, segment.shape, 0, elites.phase.shape[1])
    qpos, qvel, phase = (x[segment, row] for x in (elites.qpos, elites.qvel, elites.phase))
    d = config.noise * jax.random.normal(noise_key, qvel.shape)
    d = d.at[:, :6].set(0.0)
    if layout.others:
        d = d.at[:, layout.own.nv :].set(0.0)
    return phase, jax.vmap(lambda q, move: pose.plus(layout, q, move))(qpos, d), qvel


def update(
    config: EvolutionConfig, elites: Elites, visited: Visited, key: jax.Array, length: jax.Array
) -> Elites:
    """Returns the elites drawn from old ones and visited states. The key is consumed.

    Args:
      config: how.
      elites: `[S, M]` old ones; at least they remain, so every segment stays full.
      visited: `[N]` states; those with a value that is not finite are left out.
      key: of the draw.
      length: control frames in a cycle.
    """
    segments, count = elites.phase.shape
    place = jnp.floor(visited.phase / length * segments).astype(jnp.int32)
    place = jnp.clip(place, 0, segments - 1)
    finite = jnp.isfinite(visited.value)
    finite &= jnp.isfinite(visited.qpos).all(-1) & jnp.isfinite(visited.qvel).all(-1)

    def one(segment: jax.Array, old: Elites, key: jax.Array) -> Elites:
        member = finite & (place == segment)
        value = jnp.concatenate((config.decay * old.value, visited.value))
        member = jnp.concatenate((jnp.ones(count, bool), member))
        rows = _choose(config.greed, value, member, key, count)
        pool = jax.tree.map(
            lambda a, b: jnp.concatenate((a, b))[rows],
            (old.qpos, old.qvel, old.phase),
            (visited.qpos, visited.qvel, visited.phase),
        )
        return Elites(*pool, value=value[rows])

    keys = jax.random.split(key, segments)
    return jax.vmap(one)(jnp.arange(segments), elites, keys)


def _choose(
    greed: float, value: jax.Array, member: jax.Array, key: jax.Array, count: int
) -> jax.Array:
    """Returns `[count]` different rows of the members, by Gumbel's trick."""
    high = jnp.max(jnp.where(member, value, -jnp.inf))
    low = jnp.min(jnp.where(member, value, jnp.inf))
    score = greed * (value - high) / (high - low + 0.01) + jax.random.gumbel(key, value.shape)
    return jax.lax.top_k(jnp.where(member, score, -jnp.inf), count)[1]


def validate(config: EvolutionConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 1 <= config.elites <= 100_000:
        raise UserError(f"evolution.elites is {config.elites}: give 1 to 100000")
    if not 0 <= config.decay <= 1:
        raise UserError(f"evolution.decay is {config.decay}: give 0 to 1")
    for name in ("greed", "noise"):
        if not 0 <= getattr(config, name) < 1000:
            raise UserError(f"evolution.{name} is {getattr(config, name)}: give 0 or more")
