# SPDX-License-Identifier: Apache-2.0
"""Servos with limited torque, the same for every backend.

The servos themselves run inside the engine (see `character.compile`). Torque is limited by keeping
the set point near the joint: a clamped actuator would lose its implicit damping. It has to be made
anew in each physics step.

`discrete` takes spring and damper at the end of the step, which is not known when the set point is
made. A limit at its beginning takes torque back as the joint moves on, all of it at 10 rad/s in a
few steps of 1/120 s. So the end is guessed, by the acceleration of the step before. What a guess
is off by, the next one is off by the other way round: over a push the limit is met exactly.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import pose
from jaxskills.character import Character
from jaxskills.physics.base import SimState


@struct.dataclass
class Servos:
    """The nu servos; arrays, so torque limits can be swept or varied."""

    kp: jax.Array  # [nu] N m / rad
    kd: jax.Array  # [nu] N m s / rad
    torque: jax.Array  # [nu] N m
    dofs: tuple[int, ...] = struct.field(pytree_node=False)  # displacement index of each servo


def of(character: Character) -> Servos:
    """Returns the servos of a character."""
    numbers = (character.kp, character.kd, character.torque)
    dofs = tuple(int(dof) for dof in character.actuated)
    return Servos(*(jnp.asarray(x, jnp.float32) for x in numbers), dofs=dofs)


def unlimited(servos: Servos) -> Servos:
    """Returns the servos without a largest torque, the superhuman of FS section 7.4."""
    return dataclasses.replace(servos, torque=jnp.full_like(servos.torque, jnp.inf))


def controls(
    servos: Servos,
    layout: pose.Layout,
    sim: SimState,
    target: jax.Array,
    speed: jax.Array,
    timestep: float,
) -> jax.Array:
    """Returns the controls `[nu]` (rad) with the torque kp (target - q) + kd (speed - v), limited.

    For one physics step, q and v at its end. The difference is the displacement that leads to the
    target. Rotation vectors, in which the engine's servos measure, have a difference that points
    beside it by half of the joint's turn: 30 degrees at a shoulder 1 rad from its zero pose, 70 at
    2.5 rad.

    Args:
      servos: their gains.
      layout: of the poses.
      sim: before the step. Its warm start is the acceleration of the step before, 0 at first.
      target: `[nq]` pose to get to.
      speed: `[nv]` velocity that the target moves at.
      timestep: s, of the step.
    """
    dofs = jnp.array(servos.dofs)
    end = (sim.qvel + timestep * sim.qacc)[dofs]
    error = pose.minus(layout, target, sim.qpos)[dofs] - timestep * end
    torque = servos.kp * error + servos.kd * (speed[dofs] - end)
    torque = jnp.clip(torque, -servos.torque, servos.torque)
    now = pose.rotation_vectors(layout, sim.qpos)[dofs]
    return now + timestep * end + (torque + servos.kd * end) / servos.kp


def applied_torque(
    servos: Servos, layout: pose.Layout, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array
) -> jax.Array:
    """Returns the torque `[nu]` (N m) that the servos apply in state `(qpos, qvel)`."""
    dofs = jnp.array(servos.dofs)
    error = ctrl - pose.rotation_vectors(layout, qpos)[dofs]
    return servos.kp * error - servos.kd * qvel[dofs]
