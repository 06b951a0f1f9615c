# SPDX-License-Identifier: Apache-2.0
"""A family of motions as it is learnt: elites, parameterisation, curriculum, and what comes next.

At first only the reference itself is learnt (pi_0 of FS 5.3), until the policy gets through it
reliably. From then on each update asks for a batch of task parameters, each with the motion that is
known best for it, and takes in the episodes that come of them.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills.errors import UserError
from jaxskills.explore import curriculum as curriculum_lib
from jaxskills.explore import elites as elites_lib
from jaxskills.explore import fitness as fitness_lib
from jaxskills.explore import lean as lean_lib
from jaxskills.explore import marginal as marginal_lib
from jaxskills.explore import parameterization as parameterization_lib
from jaxskills.explore.elites import Elites, Episodes
from jaxskills.variation import VariationConfig

# What an update shows: see `watched`.
WATCHED = (
    "episodes",  # N of FS table 1
    "base_learnt",
    "success",
    "explored",  # ER of FS table 1
    "elites",
    "entered",
    "counted",
    "fitness",
    "task_error",  # share of the range: how far what was met is from what was asked for
    "refining",
    "rate_around",
    "rate_inside",
    "marginal",
    "motion_loss",
    "network_trusted",
)


@dataclasses.dataclass(frozen=True)
class FamilyConfig:
    """How a family is learnt."""

    episodes: float = 2.5  # motions that each environment has time for in an update
    # Off: the motion to imitate is the reference itself, whatever the task, without a
    # parameterisation; A1 of FS 7.2 with `env.time_warp` off too.
    vary: bool = True
    late: float = 0.2  # share of the starts that lie somewhere in the motion, where the task allows
    # The reference itself is learnt when that share of the episodes get through it, and the reward
    # has not grown by so much for some updates.
    base_late: float = 0.7  # share of late starts until then, anywhere
    base_success: float = 0.8
    base_growth: float = 0.02  # share of the reward
    base_patience: int = 3  # updates
    base_memory: float = 0.7  # of the running means of both, with each update
    # Of the fitness of the elite nearest to what was asked for, that an episode must have to count
    # as a success for the curriculum.
    quality: float = 0.5
    variation: VariationConfig = VariationConfig()
    elites: elites_lib.EliteConfig = elites_lib.EliteConfig()
    fitness: fitness_lib.FitnessConfig = fitness_lib.FitnessConfig()
    parameterization: parameterization_lib.ParameterizationConfig = (
        parameterization_lib.ParameterizationConfig()
    )
    curriculum: curriculum_lib.CurriculumConfig = curriculum_lib.CurriculumConfig()
    marginal: marginal_lib.MarginalConfig = marginal_lib.MarginalConfig()
    lean: lean_lib.LeanConfig = lean_lib.LeanConfig()


@struct.dataclass
class Base:
    """How far the reference itself is learnt."""

    success: jax.Array  # [] share of episodes that get through, running mean
    reward: jax.Array  # [] per control frame, running mean
    best: jax.Array  # [] the highest of these
    stale: jax.Array  # [] int32 updates since it has grown
    updates: jax.Array  # [] int32
    learnt: jax.Array  # [] bool


@struct.dataclass
class Asked:
    """The batch of W task parameters that comes next."""

    a: jax.Array  # [W, P]
    region: jax.Array  # [W] int32
    x: jax.Array  # [W, M] variations to imitate, flattened
    fed: jax.Array  # [W, M] variations that are fed forward


@struct.dataclass
class Family:
    """Everything about the family but policy and value function."""

    base: Base
    elites: Elites
    network: parameterization_lib.Parameterization
    marginal: marginal_lib.Marginal
    curriculum: curriculum_lib.Curriculum
    asked: Asked
    episodes: jax.Array  # [] uint32, N of FS table 1: all that were begun


@struct.dataclass
class Results:
    """What an update of policy and value function gives the family to learn from."""

    episodes: Episodes  # [Q] those that got through the motion
    variant: jax.Array  # [Q] int32, which of the W was asked for
    a: jax.Array  # [S, P] of visited states
    value: jax.Array  # [S] of them, in units of the largest return
    begun: jax.Array  # [] episodes
    success: jax.Array  # [] share of those from phase 0 that got through
    reward: jax.Array  # [] per control frame


def first(config: FamilyConfig, reference: jax.Array, size: int) -> Asked:
    """Returns what is asked for at the beginning: the reference alone. Arguments as of `init`."""
    batch = config.curriculum.batch
    itself = jnp.zeros((batch, size))
    return Asked(jnp.tile(reference, (batch, 1)), jnp.zeros(batch, jnp.int32), itself, itself)


def init(config: FamilyConfig, reference: jax.Array, size: int, key: jax.Array) -> Family:
    """Returns the beginning, which asks for the reference alone.

    Args:
      config: how.
      reference: `[P]` task parameters of the reference motion.
      size: M, numbers of a variation.
      key: consumed.
    """
    network_key, marginal_key = jax.random.split(key)
    count = reference.shape[0]
    none = jnp.zeros(()), jnp.int32(0)
    base = Base(none[0], none[0], none[0], none[1], none[1], jnp.bool_(False))
    return Family(
        base,
        elites_lib.init(roomy(config.elites, count), count, size),
        parameterization_lib.init(config.parameterization, count, size, network_key),
        marginal_lib.init(config.marginal, count, marginal_key),
        curriculum_lib.init(config.curriculum, reference),
        first(config, reference, size),
        jnp.uint32(0),
    )


def roomy(config: elites_lib.EliteConfig, parameters: int) -> elites_lib.EliteConfig:
    """Returns the configuration with no more rows than elites that keep apart can fill.

    Some lie outside the task space, so it is taken wider than it is.
    """
    most = max(256, round(4.0 * (1.0 + 1.0 / config.radius) ** parameters))
    return dataclasses.replace(config, capacity=min(config.capacity, most))


def update(
    config: FamilyConfig, family: Family, results: Results, key: jax.Array
) -> tuple[Family, dict[str, jax.Array]]:
    """Returns the family after an update, with what to ask for next, and what to watch.

    The key is consumed.
    """
    network_key, marginal_key, ask_key = jax.random.split(key, 3)
    keeping = roomy(config.elites, results.a.shape[1])
    elites, entered, counted = elites_lib.insert(keeping, family.elites, results.episodes)
    asked, batch = family.asked.a, family.asked.region.shape[0]
    wanted = asked[results.variant]
    done = jnp.minimum(results.success, good(config, family.elites, results.episodes, wanted))
    found = jnp.zeros(batch).at[results.variant].add(counted)
    network = parameterization_lib.update(
        config.parameterization, family.network, elites, network_key
    )
    marginal, _ = marginal_lib.update(
        config.marginal, family.marginal, results.a, results.value, marginal_key
    )
    curriculum = jax.lax.cond(
        family.base.learnt,
        lambda: curriculum_lib.update(
            config.curriculum, family.curriculum, family.asked.region, found, done
        ),
        lambda: family.curriculum,
    )
    base = _base(config, family.base, results)
    family = Family(
        base,
        elites,
        network,
        marginal,
        curriculum,
        family.asked,
        family.episodes + jnp.uint32(results.begun),
    )
    family = jax.lax.cond(
        base.learnt, lambda: _ask(config, keeping, family, ask_key), lambda: family
    )
    return family, watched(config, family, results, asked, entered, counted)


def good(config: FamilyConfig, elites: Elites, episodes: Episodes, asked: jax.Array) -> jax.Array:
    """Returns which share `[]` of the episodes is nearly as fit as the elites they should be like.

    Those nearest to what was asked for, `asked [N, P]`: at the rim of what is explored elites are
    less fit than inside.
    """
    least = config.quality * elites_lib.nearest_fitness(elites, asked)
    passed = episodes.valid & (episodes.fitness >= least)
    return jnp.sum(passed) / jnp.maximum(jnp.sum(episodes.valid), 1)


def _ask(
    config: FamilyConfig, keeping: elites_lib.EliteConfig, family: Family, key: jax.Array
) -> Family:
    """Returns the family with the next batch. The key is consumed."""
    renew_key, draw_key, motion_key = jax.random.split(key, 3)
    density = functools.partial(elites_lib.density, keeping, family.elites)
    value = functools.partial(marginal_lib.apply, family.marginal)
    curriculum = curriculum_lib.renew(
        config.curriculum, family.curriculum, density, value, renew_key
    )
    a, region = curriculum_lib.draw(config.curriculum, curriculum, density, draw_key)
    x = parameterization_lib.draw(
        config.parameterization, family.network, family.elites, a, motion_key
    )
    asked = _asked(config, family, a, region, x)
    return dataclasses.replace(family, curriculum=curriculum, asked=asked)


def performed(config: FamilyConfig, family: Family) -> jax.Array:
    """Returns the variation `[M]` that the reference becomes when it is performed.

    Servos lag behind their targets, or reach less far, so what is performed is never what is fed
    forward. A variation is a performance: feeding it forward would make it smaller, later and
    slower once more. Without what the performance of the reference itself differs by, the targets
    are about those that it was performed with.
    """
    how, reference = config.parameterization, family.curriculum.reference
    return elites_lib.proxy(family.elites, reference, how.neighbours, how.sigma, how.ridge)


def best(config: FamilyConfig, family: Family, a: jax.Array) -> Asked:
    """Returns the motions that are known best for task parameters `a [B, P]`, as asked for.

    Those of the network once it is trusted, until then of the proxy (FS 5.3), without chance; the
    reference itself as long as nothing else was asked for.
    """
    how, network, elites = config.parameterization, family.network, family.elites
    likely = elites_lib.proxy(elites, a, how.neighbours, how.sigma, how.ridge)
    sure = parameterization_lib.trusted(how, network)
    x = jnp.where(sure, parameterization_lib.apply(network, a), likely)
    return _asked(config, family, a, jnp.zeros(a.shape[0], jnp.int32), x)


def _asked(
    config: FamilyConfig, family: Family, a: jax.Array, region: jax.Array, x: jax.Array
) -> Asked:
    """Returns what is asked for with the motions `x [B, M]`, or with the reference alone."""
    x, lag = (
        jnp.where(family.base.learnt & config.vary, v, 0.0) for v in (x, performed(config, family))
    )
    return Asked(a, region, x, x - lag)


def _base(config: FamilyConfig, base: Base, results: Results) -> Base:
    new = jnp.maximum(1.0 - config.base_memory, 1.0 / (base.updates + 1.0))
    success = base.success + new * (results.success - base.success)
    reward = base.reward + new * (results.reward - base.reward)
    grown = reward > (1.0 + config.base_growth) * base.best
    stale = jnp.where(grown, 0, base.stale + 1)
    ready = (success >= config.base_success) & (stale >= config.base_patience)
    best, learnt = jnp.where(grown, reward, base.best), base.learnt | ready
    return Base(success, reward, best, stale, base.updates + 1, learnt)


def watched(
    config: FamilyConfig,
    family: Family,
    results: Results,
    asked: jax.Array,
    entered: jax.Array,
    counted: jax.Array,
) -> dict[str, jax.Array]:
    """Returns numbers of an update for people; `asked [W, P]` was asked for."""
    good = results.episodes.valid
    count = jnp.maximum(jnp.sum(good), 1)
    level = config.curriculum.sampling.visited
    keeping = roomy(config.elites, results.a.shape[1])
    fitness = jnp.sum(jnp.where(good, results.episodes.fitness, 0.0)) / count
    wrong = jnp.mean(jnp.abs(results.episodes.a - asked[results.variant]), axis=-1)
    error = jnp.sum(jnp.where(good, wrong, 0.0)) / count
    values = (
        family.episodes,
        family.base.learnt,
        results.success,
        elites_lib.explored_ratio(keeping, family.elites, level),
        jnp.sum(family.elites.used),
        jnp.sum(entered),
        jnp.sum(counted),
        fitness,
        error,
        family.curriculum.phase == curriculum_lib.REFINEMENT,
        family.curriculum.rate[0],
        family.curriculum.rate[1],
        family.curriculum.value,
        family.network.loss,
        parameterization_lib.trusted(config.parameterization, family.network),
    )
    return dict(zip(WATCHED, values, strict=True))


def validate(config: FamilyConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 1 <= config.episodes <= 100:
        raise UserError(f"family.episodes is {config.episodes}: give 1 to 100")
    for name in ("late", "base_late", "base_success", "base_growth", "base_memory", "quality"):
        if not 0 <= getattr(config, name) < 1:
            raise UserError(f"family.{name} is {getattr(config, name)}: give 0 <= {name} < 1")
    if config.base_patience < 0:
        raise UserError(f"family.base_patience is {config.base_patience}: give 0 or more")
    elites_lib.validate(config.elites)
    fitness_lib.validate(config.fitness)
    parameterization_lib.validate(config.parameterization)
    curriculum_lib.validate(config.curriculum)
    marginal_lib.validate(config.marginal)
    lean_lib.validate(config.lean)
