# SPDX-License-Identifier: Apache-2.0
"""Which task parameters are practised: a curriculum that makes itself (FS 6.2, 6.3, 7.3).

Exploration draws from the surroundings of the heavily visited region, refinement from the region
itself. Before each batch call `renew`, then `draw`; after it `update`, with what was found.

The rates that FS 6.3 compares are counts of few elites, so phases would flicker. Two things hold
them: the rates are running means, and several updates in a row must speak for the change. At the
default numbers a single batch changes the phase only if it is off by 8 times as much as the rates
lie apart: 0.2 of it stays after the first update, 0.8^2 of that at the third.

FS does not say what happens when neither region gives anything, which is not the end: a policy that
explores one side of its region unlearns the other, and then does not even get to its own elites.
Then phases of a fixed length take turns, until something is found again. Nor does it say what keeps
exploration from running ahead of the policy, which then gets through nothing, neither the new nor
what it knew: while few episodes get through, nothing new is explored. And a few probes find less
than a batch that the policy learns from, so refinement, which always finds a little, ends after
some updates anyway.
"""

import dataclasses
import math
from typing import Literal, get_args

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills.errors import UserError, unknown
from jaxskills.explore import sampling
from jaxskills.explore.sampling import SURROUNDING, VISITED, Function, SamplingConfig

Method = Literal[
    "alternating_by_rate",  # FS: whichever region gives more new elites
    "uniform",  # the whole task space alike, without phases
    "explore_only",  # no refinement before everything is explored
    "mastering",  # refines until the values are high, explores until they are not
    "fixed_alternation",  # phases of fixed length
]

EXPLORATION, REFINEMENT = 0, 1  # phases


@dataclasses.dataclass(frozen=True)
class CurriculumConfig:
    """The method, and what each of them needs."""

    method: Method = "alternating_by_rate"
    batch: int = 20  # task parameters of an update
    sampling: SamplingConfig = SamplingConfig()
    renew: int = 5  # updates from one MCMC to the next
    # alternating_by_rate
    probes: int = 2  # of a batch come from the region that it is not the phase of
    memory: float = 0.8  # of the running mean of an exploration rate, with each update
    patience: int = 3  # updates in a row must speak for a change of phase; of mastering too
    success: float = 0.5  # with fewer episodes that get through there is refinement
    idle: float = 0.01  # with both rates below that, nothing is found,
    idle_duration: int = 8  # and phases have so many updates
    longest: int = 20  # updates of refinement at a time, if more get through
    # explore_only
    full: float = 0.99  # share of the task space that is everything
    # mastering
    mastery: float = 0.5  # mean marginal value, in the unit of the values given
    timeout: int = 50  # updates, of either phase
    # fixed_alternation
    duration: int = 20  # updates of a phase


@struct.dataclass
class Curriculum:
    """Where the curriculum stands between two updates."""

    phase: jax.Array  # [] int32, EXPLORATION or REFINEMENT
    rate: jax.Array  # [2] new elites a task parameter, in the surroundings and the visited region
    seen: jax.Array  # [2] int32 updates in which a rate was measured
    age: jax.Array  # [] int32 updates in this phase
    streak: jax.Array  # [] int32 last updates that spoke for the other phase
    updates: jax.Array  # [] int32
    pool: jax.Array  # [sampling.pool, P] of the visited region, by MCMC
    value: jax.Array  # [] mean marginal value over the visited region, at the last MCMC
    explored: jax.Array  # [] visited share of the task space, at the last MCMC
    reference: jax.Array  # [P] task parameters of the reference motion


def init(config: CurriculumConfig, reference: jax.Array) -> Curriculum:
    """Returns a curriculum that begins to explore around `reference [P]`.

    Raises:
      UserError: a value out of range.
    """
    validate(config)
    pool = jnp.tile(reference, (config.sampling.pool, 1))
    zero, nothing = jnp.int32(0), jnp.zeros(())
    rates = jnp.zeros(2), jnp.zeros(2, jnp.int32)
    phase = jnp.int32(EXPLORATION)
    return Curriculum(phase, *rates, zero, zero, zero, pool, nothing, nothing, reference)


def renew(
    config: CurriculumConfig, state: Curriculum, density: Function, value: Function, key: jax.Array
) -> Curriculum:
    """Returns the curriculum with what is measured every `renew` updates, as at the first.

    Args:
      config: how.
      state: before.
      density: of elites, `[P] -> []`.
      value: the marginal value, `[..., P] -> [...]`.
      key: consumed.
    """

    def measured(state: Curriculum) -> Curriculum:
        survey_key, walk_key = jax.random.split(key)
        c, reference = config.sampling, state.reference
        points = sampling.survey(c, density, reference, survey_key)
        return dataclasses.replace(
            state,
            pool=sampling.mcmc(c, density, value, reference, points, walk_key),
            value=sampling.mean(c, points, value, reference),
            explored=sampling.explored(c, points),
        )

    return jax.lax.cond(state.updates % config.renew == 0, measured, lambda state: state, state)


def draw(
    config: CurriculumConfig, state: Curriculum, density: Function, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the next batch of task parameters `[batch, P]`, and the region `[batch]` of each.

    Most are of the phase's own region; `alternating_by_rate` probes the other with the last few.
    Regions are by the present density, so some may lie in another region than they were meant for.
    The key is consumed.
    """
    key, survey_key, pool_key = jax.random.split(key, 3)
    if config.method == "uniform":
        a = jax.random.uniform(key, (config.batch, state.reference.shape[0]))
    else:
        points = sampling.survey(config.sampling, density, state.reference, survey_key)
        new = sampling.surrounding(config.sampling, points, state.reference, key, config.batch)
        rows = jax.random.randint(pool_key, (config.batch,), 0, len(state.pool))
        probes = config.probes if config.method == "alternating_by_rate" else 0
        probe = jnp.arange(config.batch) >= config.batch - probes
        explore = (state.phase == EXPLORATION) != probe
        a = jnp.where(explore[:, None], new, state.pool[rows])
    return a, sampling.region(config.sampling, jax.vmap(density)(a))


def update(
    config: CurriculumConfig,
    state: Curriculum,
    region: jax.Array,
    found: jax.Array,
    success: jax.Array | float = 1.0,
) -> Curriculum:
    """Returns the curriculum after a batch, perhaps in the other phase (FS 6.3).

    Args:
      config: how.
      state: before.
      region: `[batch]` of its task parameters.
      found: `[batch]` new elites that count, of the episodes of each task parameter.
      success: `[]` share of the episodes that got through the motion.
    """
    # Only all over an explored space does this method draw none of the surroundings.
    around, inside = (region == SURROUNDING).any(), (region == VISITED).any()
    complete = inside & ~around & (config.method == "alternating_by_rate")
    state = _measured(config, state, region, found, complete)
    age = state.age + 1
    wish, hurry = _opinion(config, state, age, complete, success < config.success)
    streak = jnp.where(wish, state.streak + 1, 0)
    change = (streak >= config.patience) | hurry
    return dataclasses.replace(
        state,
        phase=jnp.where(change, 1 - state.phase, state.phase),
        age=jnp.where(change, 0, age),
        streak=jnp.where(change, 0, streak),
        updates=state.updates + 1,
    )


def _measured(
    config: CurriculumConfig,
    state: Curriculum,
    region: jax.Array,
    found: jax.Array,
    complete: jax.Array,
) -> Curriculum:
    """Returns the curriculum with the batch's exploration rates taken in.

    Per task parameter, since regions have different numbers of them. A region without any keeps
    its rate; but in a space that is explored completely the surroundings give nothing.
    """
    member = region == jnp.array([[SURROUNDING], [VISITED]])
    count = jnp.sum(member, axis=1)
    mean = member @ jnp.asarray(found, jnp.float32) / jnp.maximum(count, 1)
    known = (count > 0) | jnp.array([complete, False])
    share = jnp.where(known, jnp.maximum(1.0 - config.memory, 1.0 / (state.seen + 1.0)), 0.0)
    rate = state.rate + share * (mean - state.rate)
    return dataclasses.replace(state, rate=rate, seen=state.seen + known)


def _opinion(
    config: CurriculumConfig,
    state: Curriculum,
    age: jax.Array,
    complete: jax.Array,
    poor: jax.Array | bool,
) -> tuple[jax.Array, jax.Array]:
    """Returns whether this update speaks for the other phase, and whether it comes at once."""
    exploring, no = state.phase == EXPLORATION, jnp.asarray(False)
    match config.method:
        case "alternating_by_rate":
            less = complete | (state.rate[0] < state.rate[1])
            more = ~complete & (state.rate[0] > state.rate[1])
            known, idle = (state.seen > 0).all(), (state.rate < config.idle).all() & ~complete
            decided = jnp.where(exploring, less, more) & known & ~idle
            decided = jnp.where(exploring, decided | poor, decided & ~poor)
            turn = idle & known & (age >= config.idle_duration)
            turn |= ~exploring & ~complete & (age >= config.longest)
            return decided, turn & (exploring | ~jnp.asarray(poor))
        case "mastering":
            mastered = state.value >= config.mastery
            return jnp.where(exploring, ~mastered, mastered), age >= config.timeout
        case "explore_only":
            return no, exploring & (state.explored >= config.full)
        case "fixed_alternation":
            return no, age >= config.duration
        case _:
            return no, no


def validate(config: CurriculumConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range or an unknown method.
    """
    if config.method not in get_args(Method):
        raise unknown("curriculum method", config.method, get_args(Method))
    sampling.validate(config.sampling)
    for name in ("batch", "renew", "patience", "idle_duration", "longest", "timeout", "duration"):
        if getattr(config, name) < 1:
            raise UserError(f"curriculum.{name} is {getattr(config, name)}: give 1 or more")
    if config.batch > config.sampling.pool:
        raise UserError(
            f"curriculum.batch is {config.batch}: give 1 to {config.sampling.pool} (sampling.pool)"
        )
    if not 1 <= config.probes < config.batch and config.method == "alternating_by_rate":
        raise UserError(f"curriculum.probes is {config.probes}: give 1 to {config.batch - 1}")
    if not 0 <= config.idle < math.inf:
        raise UserError(f"curriculum.idle is {config.idle}: give a rate of 0 or more")
    if not 0 <= config.success < 1:
        raise UserError(f"curriculum.success is {config.success}: give 0 <= success < 1")
    if not 0 <= config.memory < 1:
        raise UserError(f"curriculum.memory is {config.memory}: give 0 <= memory < 1")
    if not 0 < config.full <= 1:
        raise UserError(f"curriculum.full is {config.full}: give 0 < full <= 1")
    if not math.isfinite(config.mastery):
        raise UserError(f"curriculum.mastery is {config.mastery}: give a finite value")
