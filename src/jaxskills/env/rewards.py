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
    """Weights of the joints in DeepMimic's imitation reward."""

    dof_weight: jax.Array  # [nv - 6] each joint's weight on each of its axes, summing to 1 a joint
    root_weight: jax.Array  # []


# Those of the code of DeepMimic and of SB's comparison with it. Section 5.2 of Peng et al. 2018
# prints 0.65, 0.1, 0.15 for the first three and 0.1 for where the CoM is, without the root's term.
TERMS = {"pose": 0.5, "velocity": 0.05, "end_effectors": 0.15, "root": 0.2, "com": 0.1}
SCALES = {"pose": 2.0, "velocity": 0.1, "end_effectors": 40.0, "root": 5.0, "com": 1.0}
# Within the root's term: height (m), turn (rad), their velocities.
_ROOT = {"height": 1.0, "turn": 0.1, "linear": 0.01, "angular": 0.001}


def imitation_weights(character: Character) -> Imitation:
    """Returns the weights of a character's joints, normalised to sum to 1 with the root's 1."""
    total = 1.0 + sum(character.weights.values())
    layout = character.layout.own
    per_dof = np.zeros(layout.nv - 6)
    for joint in layout.joints[1:]:
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
    """Returns DeepMimic's imitation reward in [0, 1] (r_i of SB eq. 13).

    Where the root is horizontally does not count, only how it moves, as in SB's comparison: over
    20 s without bounds it drifts from the reference.

    Args:
      weights: of the joints.
      offset: `[nv]` displacement from the simulated pose to the reference (m, rad).
      velocity_error: `[nv]` difference of the velocities (m/s, rad/s).
      effectors: end effectors `[E, 3]` of both, each in its own heading frame (m).
      bodies: the simulated bodies.
      reference: the reference's.
    """

    def weighted(d: jax.Array) -> jax.Array:
        return weights.root_weight * square(d[3:6]) + jnp.sum(weights.dof_weight * d[6:] ** 2)

    def square(d: jax.Array) -> jax.Array:
        return jnp.sum(d**2)

    root = {
        "height": offset[2] ** 2,
        "turn": square(offset[3:6]),
        "linear": square(velocity_error[:3]),
        "angular": square(velocity_error[3:6]),
    }
    error = {
        "pose": weighted(offset),
        "velocity": weighted(velocity_error),
        "end_effectors": square(effectors[0] - effectors[1]) / max(len(effectors[0]), 1),
        "root": sum(weight * root[name] for name, weight in _ROOT.items()),
        "com": square(bodies.com_vel - reference.com_vel),
    }
    terms = [weight * jnp.exp(-SCALES[name] * error[name]) for name, weight in TERMS.items()]
    return jnp.sum(jnp.stack(terms))
