# SPDX-License-Identifier: Apache-2.0
"""Servo set points with limited torque, the same for every backend.

The servos themselves run inside the engine (see `character.compile`). Torque is limited by keeping
the set point within torque/kp of the joint: a clamped actuator would lose its implicit damping.
"""

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import pose
from jaxskills.character import Character


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


def set_point(
    servos: Servos, layout: pose.Layout, qpos: jax.Array, qvel: jax.Array, target: jax.Array
) -> jax.Array:
    """Returns the controls `[nu]` (rad) that pull the pose `qpos [nq]` towards `target [nq]`.

    The whole torque kp (ctrl - q) - kd v is within the limit when the control step begins. Limiting
    the first term alone would cap joint speeds at torque/kd, 3 rad/s at a knee that runs at 10.
    """
    dofs = jnp.array(servos.dofs)
    now = pose.rotation_vectors(layout, qpos)[dofs]
    error = pose.rotation_vectors(layout, target)[dofs] - now
    damping = servos.kd * qvel[dofs]
    low, high = (damping - servos.torque) / servos.kp, (damping + servos.torque) / servos.kp
    return now + jnp.clip(error, low, high)


def applied_torque(
    servos: Servos, layout: pose.Layout, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array
) -> jax.Array:
    """Returns the torque `[nu]` (N m) that the servos apply in state `(qpos, qvel)`."""
    dofs = jnp.array(servos.dofs)
    error = ctrl - pose.rotation_vectors(layout, qpos)[dofs]
    return servos.kp * error - servos.kd * qvel[dofs]
