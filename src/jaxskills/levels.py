# SPDX-License-Identifier: Apache-2.0
"""References brought to the level of the ground that they begin on, and of the body they are of."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxskills import ground, kinematics
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.kinematics import BodyParams, Tree
from jaxskills.motion import CONTROL_DT, Motion

Own = tuple[BodyParams, ground.Shapes]


def raised(character: Character, motion: Motion) -> Motion:
    """Returns the motion, higher by the box that it begins on if there is one.

    All of it is: where it goes from there is left to whoever performs it.
    """
    own = kinematics.body_params(character.model), ground.shapes(character.model)
    if own[1].boxes is None:
        return motion
    tree = kinematics.tree(character.model)
    first = dataclasses.replace(motion, qpos=motion.qpos[:1], qvel=motion.qvel[:1])
    floor, top = jit(lambda: _heights(tree, first, own))()[0]
    return dataclasses.replace(motion, qpos=motion.qpos.at[:, 2].add(floor - top))


def of_variants(tree: Tree, shown: Motion, own: Own, others: Own) -> Motion:
    """Returns the motions `[W]` of other bodies: as far over the ground as on the character's own.

    Longer legs would reach into it, shorter ones hang above. What a variant begins on counts like
    in `raised`.

    Args:
      tree: of the character.
      shown: the reference on the character's own body.
      own: that body and its ground.
      others: `[W]` the bodies of the variants and their ground.
    """
    frame = shown.length * CONTROL_DT / (shown.qpos.shape[0] - 1)
    before = _heights(tree, shown, own)

    def of(other: Own) -> Motion:
        change = before - _heights(tree, shown, other)
        lift = change[:, 0]
        begin = change[0, 1] - lift[0]
        qpos = shown.qpos.at[:, 2].add(lift + begin)
        qvel = shown.qvel.at[:, 2].add(jnp.asarray(jnp.gradient(lift)) / frame)
        return dataclasses.replace(shown, qpos=qpos, qvel=qvel)

    return jax.vmap(of)(others)


def _heights(tree: Tree, motion: Motion, own: Own) -> jax.Array:
    """Returns how far each pose is over the floor, and over the ground with its boxes, `[F, 2]`."""
    body, shapes = own
    flat = dataclasses.replace(shapes, boxes=None)

    def one(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        bodies = kinematics.kinematics(tree, body, qpos, qvel)
        over = [ground.clearance(x, bodies, inside=True) for x in (flat, shapes)]
        return jnp.stack([jnp.min(x) for x in over])

    return jax.vmap(one)(motion.qpos, motion.qvel)
