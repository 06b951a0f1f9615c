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
from jaxskills import variation as variation_lib
from jaxskills.character import Character
from jaxskills.env import holds
from jaxskills.env.holds import Holds
from jaxskills.ground import Shapes
from jaxskills.kinematics import BodyParams
from jaxskills.motion import Motion, sample
from jaxskills.pose import Layout
from jaxskills.variation import Variation


@struct.dataclass
class Fed:
    """A motion that is fed forward in the place of the reference."""

    motion: Motion
    variation: Variation  # what made it of the clip


@struct.dataclass
class Variant:
    """One variant, or W of them stacked."""

    motion: Motion  # the reference
    variation: Variation  # what made it of the clip; its speed of phase is part of the reference
    body: BodyParams  # lengths and masses
    shapes: Shapes  # what can touch the ground
    task: jax.Array  # [P] the task parameter, normalised; P is 0 for a skill
    holds: Holds | None = None  # what hands may hold
    fed: Fed | None = None  # what is fed forward, if it is not the reference itself
    # (qpos [nq], qvel [nv]) at phase 0, if the reference does not say so
    first: tuple[jax.Array, jax.Array] | None = None


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
    itself = variation_lib.zeros(2, character.layout.nv)
    return stack([row(character, motion, itself, jnp.zeros(0))], model)


def row(character: Character, motion: Motion, variation: Variation, task: jax.Array) -> Variant:
    """Returns one variant.

    Args:
      character: who; bodies may differ between variants in size and mass.
      motion: the reference, `variation.displace` of the clip.
      variation: that made it.
      task: `[P]` the task parameter, normalised.
    """
    params, shapes = kinematics.body_params(character.model), ground.shapes(character.model)
    return Variant(motion, variation, params, shapes, task, holds.of(character.model))


def stack(rows: Sequence[Variant], model: Any) -> Variants:
    """Returns variants in one; their references have the same length in phase."""
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *rows)
    first = rows[0].motion
    return Variants(stacked, model, len(rows), float(first.length), first.loop)


def begin(layout: Layout, own: Variant, phase: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the state `qpos [nq]`, `qvel [nv]` in which an episode begins at `phase []`."""
    there = sample(layout, own.motion, phase)
    if own.first is None:
        return there
    qpos, qvel = (
        jnp.where(phase > 0.0, x, first) for x, first in zip(there, own.first, strict=True)
    )
    return qpos, qvel


def pick(variants: Variants, index: jax.Array) -> Variant:
    """Returns one variant by its index `[]`. The only one needs no looking up."""
    place = 0 if variants.count == 1 else index
    return jax.tree.map(lambda x: x[place], variants.rows)
