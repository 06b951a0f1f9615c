# SPDX-License-Identifier: Apache-2.0
"""Style rewards: how much energy, how much room, or like which clip (SB section 3.3, eq. 4 to 8).

Spacetime bounds leave room inside of them; a style reward says which of the motions in that room is
wanted. The reward of a step is style times regulariser, earned while inside the bounds. How like a
clip a motion is, `gram.py` says.
"""

import dataclasses
import itertools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills import kinematics
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies, BodyParams
from jaxskills.motion import CONTROL_DT

Style = Literal["none", "energy_up", "energy_down", "volume_up", "volume_down", "gram"]

_JITTER = 1e-4  # m, see `hull_volume`
_LONGEST_LOOK = 60.0  # s


@dataclasses.dataclass(frozen=True)
class StyleConfig:
    """Which style, and how it is measured."""

    style: Style = "none"
    energy: tuple[float, float] = (20.0, 100.0)  # J, SB section 5.3.1
    volume: float = 0.12  # m^3, alpha of SB eq. 5, section 5.3.1
    style_clip: str | None = None  # for gram: name or file of the clip whose style is wanted
    autoencoder: str | None = None  # for gram: npz file; None: the one shipped, for `humanoid34`
    gram: float = 0.4  # alpha of SB eq. 6, for distances from 0 to 1.4, see `gram.distance`
    # What the reward looks back over, in s; None: one cycle of the reference, SB section 5.3.2.
    look_back: float | None = None
    # Scales beta of SB eq. 7, which the paper does not give, and the share of the energy in it.
    energy_scale: float = 400.0  # J
    linear_scale: float = 100.0  # m/s^2, of each body
    angular_scale: float = 400.0  # rad/s^2, of each joint


def hull_volume(points: jax.Array) -> jax.Array:
    """Returns the volume `[]` in m^3 of the convex hull of `points [N, 3]`, for N of about 20.

    A triangle of points is a face if all others lie on one side of it; its tetrahedron to the
    centre adds to the volume. So that no four points share a plane, which would count a face twice,
    each is moved by up to 0.1 mm.
    """
    count = points.shape[0]
    jitter = np.random.default_rng(0).uniform(-_JITTER, _JITTER, (count, 3))
    points = points - jnp.mean(points, axis=0) + jnp.asarray(jitter, jnp.float32)
    triples = np.array(list(itertools.combinations(range(count), 3)))
    others = np.array([[i for i in range(count) if i not in t] for t in triples.tolist()])
    a, b, c = (points[triples[:, i]] for i in range(3))
    normal = jnp.cross(b - a, c - a)
    offset = jnp.sum(normal * a, axis=-1)
    height = jnp.einsum("fnd,fd->fn", points[others], normal) - offset[:, None]
    is_face = jnp.all(height < 0.0, axis=1) | jnp.all(height > 0.0, axis=1)
    return jnp.sum(jnp.where(is_face, jnp.abs(offset), 0.0)) / 6.0


def reward(
    config: StyleConfig,
    params: BodyParams,
    bodies: Bodies,
    before: Bodies,
    joints: jax.Array,
    likeness: jax.Array | None = None,
) -> jax.Array:
    """Returns style times regulariser `[]` in [0, 1] (SB eq. 4 to 8).

    Args:
      config: which style.
      params: of the bodies.
      bodies: after the control step.
      before: before it, for accelerations.
      joints: `[J]` angular acceleration of each joint in rad/s^2.
      likeness: `[]` for gram, the style itself (`gram.reward`).
    """
    level = kinematics.kinetic_energy(params, bodies)
    style = _style(config, level, bodies) if likeness is None else likeness
    return style * _regulariser(config, level, bodies, before, joints)


def _style(config: StyleConfig, level: jax.Array, bodies: Bodies) -> jax.Array:
    low, high = config.energy
    share = jnp.clip((level - low) / (high - low), 0.0, 1.0)
    if config.style == "energy_up":
        return share
    if config.style == "energy_down":
        return 1.0 - share
    small = jnp.exp(-hull_volume(bodies.pos) / config.volume)
    return small if config.style == "volume_down" else 1.0 - small


def _regulariser(
    config: StyleConfig, level: jax.Array, bodies: Bodies, before: Bodies, joints: jax.Array
) -> jax.Array:
    """SB eq. 7 with equal weights: one term for energy, one for each body and each joint."""
    linear = jnp.linalg.norm(bodies.lin - before.lin, axis=-1) / CONTROL_DT
    terms = jnp.concatenate(
        (
            level[None] / config.energy_scale,
            linear / config.linear_scale,
            joints / config.angular_scale,
        )
    )
    return jnp.exp(-jnp.mean(terms))


def validate(config: StyleConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not 0 <= config.energy[0] < config.energy[1]:
        raise UserError(f"style.energy is {config.energy}: give 0 <= low < high, in J")
    for name in ("volume", "gram", "energy_scale", "linear_scale", "angular_scale"):
        if not getattr(config, name) > 0:
            raise UserError(f"style.{name} is {getattr(config, name)}: give a positive number")
    if (config.style == "gram") != (config.style_clip is not None):
        raise UserError(
            f"style.style is {config.style}, style.style_clip is {config.style_clip}: gram needs"
            " the clip whose style is wanted, and no other style takes one"
        )
    if config.look_back is not None and not CONTROL_DT <= config.look_back <= _LONGEST_LOOK:
        raise UserError(
            f"style.look_back is {config.look_back}: give 1/30 to {_LONGEST_LOOK:.0f} s, or None"
        )
