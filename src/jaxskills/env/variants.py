# SPDX-License-Identifier: Apache-2.0
"""Variants: what differs between the environments of a batch, stacked; each holds an index.

A skill is one variant. A family of skills has one for each of its task parameters: another
reference, another body, another physics model.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import ground, kinematics
from jaxskills.character import Character
from jaxskills.ground import Shapes
from jaxskills.kinematics import BodyParams
from jaxskills.motion import Motion


@struct.dataclass
class Variant:
    """One variant, or W of them stacked."""

    motion: Motion  # the reference
    body: BodyParams  # lengths and masses
    shapes: Shapes  # what can touch the ground
    task: jax.Array  # [P] the task parameter, normalised; P is 0 for a skill


@struct.dataclass
class Variants:
    """W variants and their physics models, in the same order."""

    rows: Variant  # [W, ...]
    model: Any  # what `physics.load` returned for W models
    count: int = struct.field(pytree_node=False)  # W
    length: float = struct.field(pytree_node=False)  # control frames in a cycle of each reference
    loop: bool = struct.field(pytree_node=False)


def one(character: Character, motion: Motion, model: Any) -> Variants:
    """Returns the only variant of a skill.

    Args:
      character: who.
      motion: the reference.
      model: what `physics.load` returned.
    """
    return stack([row(character, motion, jnp.zeros(0))], model)


def row(character: Character, motion: Motion, task: jax.Array) -> Variant:
    """Returns one variant: a character, its reference and its task parameter `[P]`."""
    shapes = ground.shapes(character.model)
    return Variant(motion, kinematics.body_params(character.model), shapes, task)


def stack(rows: Sequence[Variant], model: Any) -> Variants:
    """Returns variants in one; their references have the same length in phase."""
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *rows)
    first = rows[0].motion
    return Variants(stacked, model, len(rows), float(first.length), first.loop)


def pick(variants: Variants, index: jax.Array) -> Variant:
    """Returns one variant by its index `[]`. The only one needs no looking up."""
    place = 0 if variants.count == 1 else index
    return jax.tree.map(lambda x: x[place], variants.rows)
