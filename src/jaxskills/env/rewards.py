# SPDX-License-Identifier: Apache-2.0
"""Rewards: survival (SB section 5) and DeepMimic's imitation, for comparison."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills.character import Character
from jaxskills.kinematics import Bodies


@struct.dataclass
class Imitation:
    """Weights of DeepMimic's imitation reward (Peng et al. 2018, section 5.2)."""

    dof_weight: jax.Array  # [nv - 6] each joint's weight on each of its axes, summing to 1 a joint
    root_weight: jax.Array  # []


TERMS = {"pose": 0.65, "velocity": 0.1, "end_effectors": 0.15, "com": 0.1}
SCALES = {"pose": 2.0, "velocity": 0.1, "end_effectors": 40.0, "com": 10.0}


def imitation_weights(character: Character) -> Imitation:
    """Returns the weights of a character's joints, normalised to sum to 1 with the root's 1."""
    total = 1.0 + sum(character.weights.values())
    per_dof = np.zeros(character.layout.nv - 6)
    for joint in character.layout.joints[1:]:
        per_dof[np.array(joint.dofs) - 6] = character.weights[joint.name] / total
    return Imitation(jnp.asarray(per_dof, jnp.float32), jnp.float32(1.0 / total))


def imitation(
    weights: Imitation,
    offset: jax.Array,
    velocity_error: jax.Array,
    effectors: tuple[jax.Array, jax.Array],
    bodies: Bodies,
    reference: Bodies,
) -> jax.Array:
    """Returns DeepMimic's imitation reward in [0, 1].

    Args:
      weights: of the joints.
      offset: `[nv]` displacement from the simulated pose to the reference (m, rad).
      velocity_error: `[nv]` difference of the velocities (m/s, rad/s).
      effectors: end effectors `[E, 3]` of both, each in its own heading frame (m).
      bodies: the simulated bodies.
      reference: the reference's.
    """

    def weighted(d: jax.Array) -> jax.Array:
        root, joints = jnp.sum(d[3:6] ** 2), jnp.sum(weights.dof_weight * d[6:] ** 2)
        return weights.root_weight * root + joints

    error = {
        "pose": weighted(offset),
        "velocity": weighted(velocity_error),
        "end_effectors": jnp.sum((effectors[0] - effectors[1]) ** 2) / max(len(effectors[0]), 1),
        "com": jnp.sum((bodies.com - reference.com) ** 2),
    }
    terms = [weight * jnp.exp(-SCALES[name] * error[name]) for name, weight in TERMS.items()]
    return jnp.sum(jnp.stack(terms))
