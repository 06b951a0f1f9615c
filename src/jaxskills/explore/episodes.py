# SPDX-License-Identifier: Apache-2.0
"""Whole episodes, found in what many environments did step by step, and what came of them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import trace
from jaxskills import variation as variation_lib
from jaxskills.env.task import Task
from jaxskills.explore.elites import Episodes
from jaxskills.explore.fitness import Judge
from jaxskills.ground import Shapes
from jaxskills.kinematics import BodyParams
from jaxskills.motion import Motion
from jaxskills.pose import Layout

_GROUP = 32  # episodes that are looked at together
_LEAST_COVERAGE = 0.99  # of the motion; whoever saw less has performed another one


@struct.dataclass
class Record:
    """T control steps of B environments, all of which began a new episode in the first."""

    qpos: jax.Array  # [T, B, nq] before the step
    qvel: jax.Array  # [T, B, nv]
    phase: jax.Array  # [T, B] control frames, before the step
    dphase: jax.Array  # [T, B] that went by
    step: jax.Array  # [T, B] int32 since the episode began
    known: jax.Array  # [T, B, M, 2] of the task's measures, before the step
    finished: jax.Array  # [T, B] bool, the episode got through all of the motion in this step


class Found(NamedTuple):
    """Q episodes, of which some are valid, and whose they are."""

    episodes: Episodes
    variant: jax.Array  # [Q] int32


def finished(
    layout: Layout,
    motions: Motion,
    own: tuple[BodyParams, Shapes],
    task: Task,
    judge: Judge,
    record: Record,
    asked: jax.Array,
    variant: jax.Array,
    knots: int,
    longest: int,
    most: int,
) -> Found:
    """Returns the episodes that went from phase 0 to the end, the first `most` of them.

    Those that miss a strict constraint do not count. The others count with the parameter that they
    met, not the one that they were asked for (FS 5.1).

    Args:
      layout: of the poses.
      motions: `[W]` the undisplaced references of the variants.
      own: `[W]` their bodies, and their shapes with the ground below.
      task: what is measured.
      judge: gives the fitness of an episode.
      record: `[T, B]`.
      asked: `[W, P]` task parameters of the variants.
      variant: `[B]` int32, which variant an environment is.
      knots: K of a variation.
      longest: control steps of an episode at most.
      most: Q, how many there may be.
    """
    last, who = jnp.nonzero(whole(record), size=most, fill_value=-1)

    def one(last: jax.Array, who: jax.Array) -> tuple[jax.Array, ...]:
        row = variant[who]
        count = record.step[last, who] + 1
        rows = jnp.clip(last - count + 1 + jnp.arange(longest), 0, record.phase.shape[0] - 1)
        valid = jnp.arange(longest) < count
        qpos, qvel, phase = (x[rows, who] for x in (record.qpos, record.qvel, record.phase))
        tau = jnp.log(record.dphase[rows, who])
        motion, mine = jax.tree.map(lambda x: x[row], (motions, own))
        made, covered = trace.trace_to_variation(layout, motion, qpos, phase, tau, valid, knots)
        known = record.known[last, who]
        met, constraint = task.hindsight(known, asked[row])
        judged = judge(qpos, qvel, phase, valid, constraint, mine)
        sound = (last >= 0) & (covered > _LEAST_COVERAGE) & task.kept(known)
        return met, variation_lib.flatten(made), judged.total, judged.likeness, sound

    def group(places: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
        shapes = jax.eval_shape(jax.vmap(one), *places)
        nothing = lambda: tuple(jnp.zeros(x.shape, x.dtype) for x in shapes)  # noqa: E731
        return jax.lax.cond(jnp.any(places[0] >= 0), lambda: jax.vmap(one)(*places), nothing)

    split = lambda x: x.reshape(-1, _GROUP)  # noqa: E731
    rows = jax.lax.map(group, (split(last), split(who)))
    return Found(Episodes(*(x.reshape(most, *x.shape[2:]) for x in rows)), variant[who])


def whole(record: Record) -> jax.Array:
    """Returns bool `[T, B]`, an episode from phase 0 got through the motion in this step."""
    return record.finished & (_at_begin(record) < 0.5)


def room(steps: int, envs: int, shortest: int) -> int:
    """Returns how many episodes of at least `shortest` steps fit, in whole groups."""
    count = envs * max(steps // max(shortest, 1), 1)
    return -(-count // _GROUP) * _GROUP


def _at_begin(record: Record) -> jax.Array:
    """Returns the phase `[T, B]` at which the episode of each step began."""
    rows = jnp.arange(record.phase.shape[0])[:, None] - record.step
    return jnp.take_along_axis(record.phase, jnp.maximum(rows, 0), axis=0)
