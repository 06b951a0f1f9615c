# SPDX-License-Identifier: Apache-2.0
"""What the policy sees: the state in a frame that moves and turns with the root (SB section 4.1).

Nothing here depends on where the character is or which way it faces, only on how it stands to the
reference. The offset from the reference is our addition: without it a policy cannot see its drift.
"""

import jax
import jax.numpy as jnp

from jaxskills import rotation
from jaxskills.kinematics import Bodies


def features(
    bodies: Bodies,
    reference: Bodies,
    offset: jax.Array,
    phase: jax.Array,
    length: jax.Array,
    axis: jax.Array,
    effectors: jax.Array,
) -> jax.Array:
    """Returns the observation `[O]`.

    Args:
      bodies: the simulated bodies.
      reference: the reference's bodies at the same phase.
      offset: `[nv]` displacement from the simulated pose to the reference.
      phase: `[]` control frames.
      length: `[]` control frames in a cycle.
      axis: `[3]` horizontal body axis that gives the heading.
      effectors: `[E, 3]` end effectors in the heading frame.
    """
    frame = rotation.heading(bodies.rot[0], axis)
    into = lambda v: rotation.turn_back(frame, v)  # noqa: E731
    cycle = 2.0 * jnp.pi * phase / length
    parts = (
        jnp.stack((jnp.sin(cycle), jnp.cos(cycle), jnp.minimum(phase / length, 1.0))),
        bodies.pos[0, 2:],
        into(bodies.pos[1:] - bodies.pos[0]),
        # Two columns of each rotation matrix say it all, without a jump anywhere.
        rotation.compose(frame.T, bodies.rot[:, :, :2]),
        into(bodies.lin),
        into(bodies.ang),
        effectors,
        into(reference.com - bodies.com),
        into(reference.com_vel - bodies.com_vel),
        into(rotation.turn(bodies.rot[0], offset[3:6])),
        offset[6:],
    )
    return jnp.concatenate([part.reshape(-1) for part in parts])
