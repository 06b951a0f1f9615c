# SPDX-License-Identifier: Apache-2.0
"""Evaluation: does the skill stand, for how long, and how close to the reference.

As in SB Table 1, bounds do not end an evaluated episode: a fall does, that is any body on the floor
that the character may not stand on. A skill with all bodies on the floor, like a roll, cannot fall:
there leaving the bounds counts as one. Actions are the policy's mean, starts are random phases. An
episode of a motion that does not loop is over soon after its end, and cannot fall any more. Bounds
have the sizes of the configuration, adaptive ones too, so that runs can be compared.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import trainer as trainer_lib
from jaxskills.character import Character
from jaxskills.env.core import Environment
from jaxskills.errors import UserError
from jaxskills.learn import normalize, rollout
from jaxskills.learn.networks import Networks
from jaxskills.motion import CONTROL_DT
from jaxskills.trainer import Trainer, TrainState

FINE_SUBSTEPS = 20  # of a control step: 600 Hz, SB section 5


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """What is measured."""

    seconds: float = 20.0  # SB Table 1
    episodes: int = 64
    substeps: int | None = None  # physics steps per control step; None: as in the training
    seed: int = 1
    start: float | None = None  # share of a cycle at which episodes begin; None: anywhere


@struct.dataclass
class Trace:
    """T steps of E evaluated episodes, going on after a fall."""

    qpos: jax.Array  # [T, E, nq]
    qvel: jax.Array  # [T, E, nv]
    phase: jax.Array  # [T, E] control frames
    errors: jax.Array  # [T, E, K] m or rad
    sizes: jax.Array  # [T, E, K] of the bounds
    inside: jax.Array  # [T, E] bool
    fallen: jax.Array  # [T, E] bool, or diverged
    over: jax.Array  # [T, E] bool, the motion has ended
    com: jax.Array  # [T, E, 3] m
    torque: jax.Array  # [T, E, nu] N m
    known: jax.Array | None = None  # [T, E, M, 2] of the measures of a family's task


def make(trainer: Trainer, config: EvaluateConfig) -> Callable[[TrainState, jax.Array], Trace]:
    """Returns the function (state, key) -> Trace, to be jitted.

    Raises:
      UserError: a value out of range.
    """
    if not CONTROL_DT <= config.seconds <= 3600:
        raise UserError(f"seconds is {config.seconds}: give 1/30 to 3600")
    if not 1 <= config.episodes <= 65536:
        raise UserError(f"episodes is {config.episodes}: give 1 to 65536")
    changed = dataclasses.replace(
        trainer.config.env,
        stop="fall",
        seconds=3600.0,
        substeps=trainer.config.env.substeps if config.substeps is None else config.substeps,
    )
    env = trainer_lib.environment(
        dataclasses.replace(trainer.config, env=changed),
        trainer.character,
        trainer.motion,
        config.episodes,
    )
    if config.start is not None and not 0 <= config.start <= 1:
        raise UserError(f"start is {config.start}: give 0 to 1, or none")
    steps = round(config.seconds / CONTROL_DT)

    def evaluate(state: TrainState, key: jax.Array) -> Trace:
        share = jax.random.uniform(key, (config.episodes,))
        if config.start is not None:
            share = jnp.full(config.episodes, config.start)
        return run(env, trainer.networks, state, share * env.length, steps)

    return evaluate


def run(
    env: Environment,
    nets: Networks,
    state: TrainState,
    phase: jax.Array,
    steps: int,
    variant: jax.Array | None = None,
) -> Trace:
    """Returns the trace of E episodes that begin on the reference at `phase [E]`.

    They are of the variants `[E]`, or of the only one.
    """

    def advance(now: rollout.Fresh, _: None) -> tuple[rollout.Fresh, Trace]:
        mean = nets.mean(state.learner.policy, normalize.apply(state.normalizer, now.obs))
        states, outcome = jax.vmap(env.step)(now.state, mean)
        report = outcome.report
        over = states.phase > env.end
        seen = Trace(
            states.sim.qpos,
            states.sim.qvel,
            states.phase,
            report.errors,
            report.sizes,
            report.inside | over,
            (report.fallen | states.sim.diverged) & ~over,
            over,
            report.com,
            report.torque,
            states.known,
        )
        return rollout.Fresh(states, outcome.obs), seen

    _, trace = jax.lax.scan(advance, rollout.begin(env, phase, variant), None, length=steps)
    return trace


def summary(trace: Trace) -> dict[str, float]:
    """Returns the figures of a trace.

    `success_rate`: share of episodes without a fall. `seconds_mean`: mean time until the fall or
    the end. `inside_bounds_rate`: share of episodes that never left the bounds;
    `inside_seconds_mean`: mean time until they first did.
    """
    fallen, outside = np.asarray(trace.fallen), ~np.asarray(trace.inside)
    return {
        "success_rate": float(1.0 - fallen.any(0).mean()),
        "seconds_mean": float(_first(fallen).mean() * CONTROL_DT),
        "inside_bounds_rate": float(1.0 - outside.any(0).mean()),
        "inside_seconds_mean": float(_first(outside).mean() * CONTROL_DT),
        "episodes": fallen.shape[1],
    }


def accuracy(character: Character, trace: Trace) -> dict[str, float | None]:
    """Returns how closely the reference is followed: means over all steps before a fall.

    `com_error_mean`: m between the centres of mass. `root_error_mean`: rad between the roots'
    orientations. `joint_error_mean`: rad between a joint and the reference's, over all of them.
    None where every episode fell at once.
    """
    gone = np.asarray(trace.fallen) | np.asarray(trace.over)
    errors = np.asarray(trace.errors)[~np.logical_or.accumulate(gone, axis=0)]
    joints = len(character.layout.own.joints) - 1  # the first is the root's
    by_name = {
        "com_error_mean": np.linalg.norm(errors[:, :3], axis=-1),
        "root_error_mean": errors[:, 3],
        "joint_error_mean": errors[:, 4 : 4 + joints],
    }
    return {name: float(x.mean()) if x.size else None for name, x in by_name.items()}


def _first(mask: np.ndarray) -> np.ndarray:
    """Returns per episode `[E]` how many steps come before the first true one in `mask [T, E]`."""
    return np.where(mask.any(0), mask.argmax(0), len(mask))
