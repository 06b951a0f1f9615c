# SPDX-License-Identifier: Apache-2.0
"""Motions that are asked for lean back to the reference, joint by joint and by chance.

An elite is an episode, with what noise and lag made of it, and the motions that come next begin
there (FS 5.2, 5.3). What no task asks for adds up on the way to the rim of a family: heads turned
aside in a high jump. Fitness would take it out again, if episodes without it came up; small noise
does not bring them. Some of the motions are therefore asked for with less of what each joint has
been displaced by. If that still does the task it is fitter, and becomes the elite.
"""

import dataclasses

import jax
import jax.numpy as jnp

from jaxskills import variation as variation_lib
from jaxskills.errors import UserError

_ROOT = 6  # how one travels and turns is the task's own, and fitness does not look at it


@dataclasses.dataclass(frozen=True)
class LeanConfig:
    """How many motions lean, and how far."""

    share: float = 0.5  # of the motions that are asked for; 0: none, as FS has it
    most: float = 0.5  # of a displacement, that may be left out


def lean(config: LeanConfig, x: jax.Array, nv: int, key: jax.Array) -> jax.Array:
    """Returns the motions `x [W, M]`, some with less displacement in their joints.

    Each axis of a joint is displaced by 1 - most to 1 times as much, all along the motion. Root and
    speed stay.

    Args:
      config: how many and how far.
      x: flattened variations.
      nv: of their displacements.
      key: consumed.
    """
    coin_key, less_key = jax.random.split(key)
    leans = jax.random.bernoulli(coin_key, config.share, (x.shape[0], 1))
    less = config.most * jax.random.uniform(less_key, (x.shape[0], nv))
    factor = jnp.where(leans & (jnp.arange(nv) >= _ROOT), 1.0 - less, 1.0)
    made = variation_lib.unflatten(x, nv)
    return variation_lib.flatten(dataclasses.replace(made, d=factor[:, None] * made.d))


def validate(config: LeanConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    for name in ("share", "most"):
        if not 0 <= getattr(config, name) <= 1:
            raise UserError(f"lean.{name} is {getattr(config, name)}: give 0 to 1")
