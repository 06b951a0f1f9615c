# SPDX-License-Identifier: Apache-2.0
"""The tracking reward of motion families: pose, end effectors, CoM and speed (FS eq. 6 and 7)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies

_TERMS = ("pose", "end_effectors", "com", "time")


@dataclasses.dataclass(frozen=True)
class TrackingConfig:
    """Scales sigma and weights w of FS section 4.2. Scales are for sums, not for means."""

    pose: float = 3.16  # rad, over all joints
    end_effectors: float = 0.8  # m, over all of them
    com: float = 0.35  # m
    time: float = 0.1  # of the speed of phase
    pose_weight: float = 0.28
    end_effectors_weight: float = 0.28
    com_weight: float = 0.28
    time_weight: float = 0.16


def terms(
    config: TrackingConfig,
    offset: jax.Array,
    bodies: Bodies,
    reference: Bodies,
    effectors: tuple[int, ...],
    rate: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Returns r_q, r_ee, r_com and r_time `[4]` of FS eq. 7, each in [0, 1].

    The pose is that of the joints; how the root is turned shows in where the end effectors are.
    Positions are those in the world, so drifting away from the reference costs.

    Args:
      config: scales.
      offset: `[nv]` displacement from the simulated pose to that of `m_a` (m, rad).
      bodies: the simulated bodies.
      reference: those of `m_a` at the same phase.
      effectors: indices of the end effectors among the bodies.
      rate: `[]` each, control frames of phase in the control step: as chosen, exp(tau), and that of
        `m_a` at the phase where the step began.
    """
    rows = np.array(effectors, int)
    errors = (
        (config.pose, offset[6:]),
        (config.end_effectors, bodies.pos[rows] - reference.pos[rows]),
        (config.com, bodies.com - reference.com),
        (config.time, rate[0] - rate[1]),
    )
    return jnp.stack([jnp.exp(-jnp.sum(error**2) / scale**2) for scale, error in errors])


def reward(
    config: TrackingConfig,
    offset: jax.Array,
    bodies: Bodies,
    reference: Bodies,
    effectors: tuple[int, ...],
    rate: tuple[jax.Array, jax.Array],
) -> jax.Array:
    """Returns r_tracking `[]` of FS eq. 6, 1 on the motion `m_a`; a reward rate over phase.

    See `terms` for the arguments.
    """
    found = terms(config, offset, bodies, reference, effectors, rate)
    return jnp.dot(jnp.array([getattr(config, f"{name}_weight") for name in _TERMS]), found)


def validate(config: TrackingConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    for name in _TERMS:
        scale, weight = getattr(config, name), getattr(config, f"{name}_weight")
        if not (0 < scale < math.inf):
            raise UserError(f"tracking.{name} is {scale}: give a number above 0")
        if not 0 <= weight <= 1:
            raise UserError(f"tracking.{name}_weight is {weight}: give 0 to 1")
