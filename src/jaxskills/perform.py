# SPDX-License-Identifier: Apache-2.0
"""A trained family performs: one whole motion for each of some task parameters.

Each begins as the reference does, on the body and in the world that the parameter asks for. Actions
are the policy's mean, the motion is the one that is known best, so nothing is left to chance. As in
an evaluation a performance ends with a fall, not where it leaves its bounds.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import evaluate, families, motion, variation
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import task as task_lib
from jaxskills.env import worlds
from jaxskills.env.task import TaskSpec
from jaxskills.env.worlds import World
from jaxskills.errors import UserError
from jaxskills.evaluate import Trace
from jaxskills.explore import family as family_lib
from jaxskills.families import Parts
from jaxskills.learn.networks import Networks
from jaxskills.motion import CONTROL_DT
from jaxskills.trainer import Trainer, TrainState


@struct.dataclass
class Performances:
    """E performances, which go on after a fall and after their end."""

    trace: Trace  # [T, E]
    reference: jax.Array  # [T, E, nq] poses of the motions m_a at the same phases
    asked: jax.Array  # [E, P] normalised task parameters
    met: jax.Array  # [E, P] those that came of it; means little unless it got through
    constraint: jax.Array  # [E] 0 to 1, how well the task's constraints were kept
    fitness: jax.Array  # [E] FS eq. 10
    steps: jax.Array  # [E] int32 until the fall or the end, T without either
    through: jax.Array  # [E] bool, it came to the end of the motion without a fall


def perform(
    made: Trainer, state: TrainState, a: np.ndarray, substeps: int | None = None
) -> Performances:
    """Returns what the family does for normalised task parameters `a [E, P]`.

    Args:
      made: the trainer of the family.
      state: how far it is.
      a: what is asked for; `env.task.from_units` makes it of values.
      substeps: physics steps of a control step; None: as in the training.

    Raises:
      UserError: the run is of one skill, or a value out of range.
    """
    return make(made, len(a), substeps)(state, a)


def make(
    made: Trainer, count: int, substeps: int | None = None
) -> Callable[[TrainState, np.ndarray], Performances]:
    """Returns `perform` for E = `count` task parameters at a time, which compiles once.

    Raises:
      UserError: as `perform`.
    """
    own, world = parts(made, count, substeps)
    run = jit(functools.partial(_perform, own, made.networks))

    def performances(state: TrainState, a: np.ndarray) -> Performances:
        asked = np.asarray(a, np.float32)
        return run(state, world(asked), asked)

    return performances


def task_of(made: Trainer) -> TaskSpec:
    """Returns what a family varies in.

    Raises:
      UserError: the run is of one skill.
    """
    if made.task is None:
        raise UserError("this run is of one skill: only a family takes task parameters")
    return made.task


def parts(
    made: Trainer, count: int, substeps: int | None = None
) -> tuple[Parts, Callable[[np.ndarray], World]]:
    """Returns the parts of `count` performances, which only a fall ends, and what makes worlds.

    Raises:
      UserError: the run is of one skill, or a value out of range.
    """
    spec, config = task_of(made), made.config
    fine = config.env.substeps if substeps is None else substeps
    env = dataclasses.replace(config.env, stop="fall", substeps=fine)
    batch = config.family.curriculum.batch  # of which the environments are a multiple
    envs = max(config.envs, -(-count // batch) * batch)
    own = families.parts(dataclasses.replace(config, env=env, envs=envs), spec)
    return own, worlds.make(own.character, own.shown, spec, own.engine, CONTROL_DT / fine)


def characters(made: Trainer, a: np.ndarray) -> list[Character]:
    """Returns the character as each of `a [E, P]` asks for it: its body, in its world."""
    spec, timestep = task_of(made), CONTROL_DT / made.config.env.substeps
    return [task_lib.variant(spec, made.character, row, timestep) for row in np.asarray(a)]


def _perform(
    own: Parts, nets: Networks, state: TrainState, world: World, a: jax.Array
) -> Performances:
    assert state.family is not None
    config, layout, count = own.config, own.character.layout, a.shape[0]
    asked = family_lib.best(config.family, state.family, a)
    env, which = families.environment(own, world, asked), jnp.arange(count, dtype=jnp.int32)
    steps = families.longest(config, own.shown)
    trace = evaluate.run(env, nets, state, jnp.zeros(count), steps, which)
    ended = trace.fallen | trace.over
    last = jnp.where(ended.any(0), jnp.argmax(ended, axis=0), steps - 1)
    assert trace.known is not None
    met, constraint = jax.vmap(own.task.hindsight)(trace.known[last, which], a)
    # Episodes are judged by the states before each step.
    begin = jax.vmap(env.start)(jnp.zeros(count), which)
    before = lambda first, rows: jnp.concatenate((first[None], rows[:-1]))  # noqa: E731
    judged = jax.vmap(own.judge, in_axes=(1, 1, 1, 1, 0, 0))(
        before(begin.sim.qpos, trace.qpos),
        before(begin.sim.qvel, trace.qvel),
        before(begin.phase, trace.phase),
        jnp.arange(steps)[:, None] <= last,
        constraint,
        (world.body, world.shapes),
    )
    varied = variation.unflatten(asked.x, layout.own.nv)
    shown = jax.vmap(functools.partial(variation.displace, layout))(world.motion, varied)
    at = lambda one, phase: motion.sample(layout, one, phase)[0]  # noqa: E731
    return Performances(
        trace=trace,
        reference=jax.vmap(jax.vmap(at, (None, 0)), (0, 1), 1)(shown, trace.phase),
        asked=a,
        met=met,
        constraint=constraint,
        fitness=judged.total,
        steps=jnp.where(ended.any(0), last + 1, steps),
        through=trace.over[last, which] & ~trace.fallen.any(0),
    )
