# SPDX-License-Identifier: Apache-2.0
"""Elite episodes of a motion family (FS 5.2): the best one found around each task parameter.

All task parameters `a [P]` are normalised, 0 to 1 over the range of each, and distances between
them are plain (A = I of FS). An episode counts with the parameters that it turned out to have, not
with those it was asked for. Its motion is a row `x [M]`, displacements and log phase speeds.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills.errors import UserError

_UNIT = 1.1  # of distances in the density of elites, in their radius


@dataclasses.dataclass(frozen=True)
class EliteConfig:
    """Who becomes an elite."""

    capacity: int = 10_000  # C, at most so many elites; the least fit goes first
    radius: float = 0.1  # r of FS 5.2: no two elites are closer
    # FS 5.2: fitness up to this is a failed episode. That is without what constraints add, which
    # may be as much: whoever keeps them by standing still has failed all the same.
    threshold: float = 0.1
    margin: float = 0.02  # FS 6.1: better by less does not count for the exploration rate


@struct.dataclass
class Elites:
    """C rows, of which those in use hold an elite each. What the others hold means nothing."""

    a: jax.Array  # [C, P] task parameters
    x: jax.Array  # [C, M] motions
    fitness: jax.Array  # [C]
    used: jax.Array  # [C] bool


@struct.dataclass
class Episodes:
    """N episodes in the order in which they ask to become elites."""

    a: jax.Array  # [N, P] task parameters they turned out to have
    x: jax.Array  # [N, M] motions
    fitness: jax.Array  # [N]
    likeness: jax.Array  # [N] fitness without constraints
    valid: jax.Array  # [N] bool, the others are ignored


def init(config: EliteConfig, parameters: int, size: int) -> Elites:
    """Returns no elites yet, with room for P = `parameters` and M = `size` numbers each."""
    rows = config.capacity
    return Elites(
        a=jnp.zeros((rows, parameters)),
        x=jnp.zeros((rows, size)),
        fitness=jnp.zeros(rows),
        used=jnp.zeros(rows, bool),
    )


def insert(
    config: EliteConfig, elites: Elites, episodes: Episodes
) -> tuple[Elites, jax.Array, jax.Array]:
    """Returns the elites after N episodes, one after the other (FS 5.2, eq. 13).

    An episode enters if its likeness is above the threshold and its fitness above that of all
    elites within the radius, which it replaces. Where there are none and no row is free, it has to
    beat the least fit elite of all, and replaces that. Ignored are episodes that are not valid or
    finite, or farther outside of the task space than the radius: nobody asks for anything there.

    With donated elites only the rows change that are written, else all of `x` is copied once.

    Returns:
      The elites; `entered [N]` bool, the episode became an elite, even where a later one replaced
      it; `counted [N]` bool, it also was better by the margin than each that it replaced, or
      replaced none, so it counts for the exploration rate (FS 6.1).
    """
    finite = jnp.isfinite(episodes.a).all(-1) & jnp.isfinite(episodes.x).all(-1)
    finite &= jnp.isfinite(episodes.fitness)
    asked_for = (jnp.abs(episodes.a - 0.5) <= 0.5 + config.radius).all(-1)
    able = episodes.valid & finite & asked_for & (episodes.likeness > config.threshold)

    # Motions stay out of the loop: they decide nothing. `writer` tells who was last to take a row.
    def one(carry: tuple[jax.Array, ...], episode: tuple[jax.Array, ...]):
        columns, fitness, used, writer = carry
        number, new_a, new_fitness, able = episode
        near = used & (_distance(columns, new_a) < config.radius**2)
        dropped = jax.lax.cond(
            jnp.any(near) | ~jnp.all(used), lambda: near, lambda: rows == jnp.argmin(fitness)
        )
        best = jnp.max(jnp.where(dropped, fitness, -jnp.inf))
        entered = able & (new_fitness > best)
        left = used & ~dropped
        row = jnp.argmin(left)  # the first that is free
        place = jnp.where(entered, row, len(rows))  # a row that does not exist is not written
        carry = (
            columns.at[:, place].set(new_a, mode="drop"),
            fitness.at[place].set(new_fitness, mode="drop"),
            jnp.where(entered, left.at[row].set(True), used),
            writer.at[place].set(number, mode="drop"),
        )
        return carry, (place, entered, entered & (new_fitness - best >= config.margin))

    rows, order = jnp.arange(elites.used.shape[0]), jnp.arange(episodes.fitness.shape[0])
    begin = elites.a.T, elites.fitness, elites.used, jnp.full_like(rows, -1)
    (columns, fitness, used, writer), (place, entered, counted) = jax.lax.scan(
        one, begin, (order, episodes.a, episodes.fitness, able)
    )
    last = writer.at[place].get(mode="fill", fill_value=-1) == order
    x = elites.x.at[jnp.where(last, place, len(rows))].set(episodes.x, mode="drop")
    return Elites(columns.T, x, fitness, used), entered, counted


def density(config: EliteConfig, elites: Elites, a: jax.Array) -> jax.Array:
    """Returns how densely elites lie around `a [..., P]`, `[...]` (FS eq. 15).

    The sum of exp(-|a_k - a|^2 / (1.1 r)^2) over the elites: FS leaves the unit open. A lone elite
    makes 1 where it is, 0.8 at 0.52 r and 0.2 at 1.4 r. With r as the unit two elites 1.95 r apart,
    between which no third fits, would make 0.77 there: less than D for ever.
    """
    near = jnp.exp(-_distance(elites.a.T, a) / (_UNIT * config.radius) ** 2)
    return jnp.sum(jnp.where(elites.used, near, 0.0), axis=-1)


def nearest_fitness(elites: Elites, a: jax.Array) -> jax.Array:
    """Returns the fitness `[...]` of the elite nearest to `a [..., P]`, 0 without any."""
    row = jnp.argmin(jnp.where(elites.used, _distance(elites.a.T, a), jnp.inf), axis=-1)
    return jnp.where(elites.used, elites.fitness, 0.0)[row]


def explored_ratio(
    config: EliteConfig, elites: Elites, level: float = 0.8, points: int = 1024
) -> jax.Array:
    """Returns the share `[]` of the task space where the density is above `level` (ER of FS 7.1).

    It is measured at fixed points, `spread`; `level` is D of FS 6.2.
    """
    places = jnp.asarray(spread(points, elites.a.shape[1]))
    return jnp.mean(density(config, elites, places) > level)


def spread(count: int, parameters: int) -> np.ndarray:
    """Returns `[count, P]` float32 points spread evenly over [0, 1)^P, always the same.

    A Kronecker sequence with the powers of 1 / g, where g^(P + 1) = g + 1 (Roberts 2018); with one
    parameter g is the golden ratio.
    """
    g = 1.5
    for _ in range(60):
        g = (1.0 + g) ** (1.0 / (parameters + 1))
    steps = g ** -np.arange(1.0, parameters + 1)
    return ((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0).astype(np.float32)


def proxy(
    elites: Elites,
    a: jax.Array,
    neighbours: int = 5,
    sigma: float = 0.28,
    ridge: float = 0.03,
) -> jax.Array:
    """Returns motions `[..., M]` for `a [..., P]`, by the nearest elites (FS 5.3, eq. 14).

    Locally linear regression: the weighted mean of the elites, and on top how they change along the
    task space, which counts where they lie farther apart than `ridge`. FS names it, but its weights
    are those of a mean, which is drawn to the middle of the elites: at the rim of what is explored,
    where the next elite is to be found, it is the motion of a place farther inside. Beyond `sigma`
    from the mean it stays as there. With fewer elites than `neighbours` all of them count; with
    none the result is zeros, which is the reference motion.

    Args:
      elites: `[C]`.
      a: task parameters.
      neighbours: k of FS 5.3, how many elites count.
      sigma: sigma_k of FS 5.3; weights are fitness times exp(-distance^2 / sigma^2).
      ridge: a large one, like 100, gives the mean alone.
    """
    squared = jnp.where(elites.used, _distance(elites.a.T, a), jnp.inf)
    closest, rows = jax.lax.top_k(-squared, min(neighbours, elites.used.shape[0]))
    # As logarithms, so that far from all elites not every weight becomes 0.
    score = jnp.log(elites.fitness[rows]) + closest / sigma**2
    score = jnp.where(elites.used[rows], score, -jnp.inf)
    weight = jax.nn.softmax(score, axis=-1, where=elites.used[rows])[..., None]
    middle = jnp.sum(weight * elites.a[rows], axis=-2)
    near, ahead = elites.a[rows] - middle[..., None, :], a - middle
    far = jnp.linalg.norm(ahead, axis=-1, keepdims=True)
    ahead = ahead * jnp.minimum(1.0, sigma / jnp.maximum(far, 1e-6))
    apart = jnp.swapaxes(weight * near, -1, -2) @ near + ridge**2 * jnp.eye(a.shape[-1])
    lever = jnp.linalg.solve(apart, ahead[..., None])
    return jnp.sum(weight * (1.0 + near @ lever) * elites.x[rows], axis=-2)


def _distance(columns: jax.Array, a: jax.Array) -> jax.Array:
    """Returns the squared distance `[..., C]` from `a [..., P]` to every column of `[P, C]`.

    Few long rows, one after the other: on a CPU several times as fast as many short ones.
    """
    return sum(((row - a[..., p, None]) ** 2 for p, row in enumerate(columns)), jnp.zeros(()))


def validate(config: EliteConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 1 <= config.capacity <= 1_000_000:
        raise UserError(f"elites.capacity is {config.capacity}: give 1 to 1000000")
    if not 0 < config.radius <= 10:
        raise UserError(f"elites.radius is {config.radius}: give a number in (0, 10]")
    for name in ("threshold", "margin"):
        if not 0 <= getattr(config, name) < 1000:
            raise UserError(f"elites.{name} is {getattr(config, name)}: give 0 or more")
