# SPDX-License-Identifier: Apache-2.0
"""Bodies and physics of a batch of task parameters, compiled on the host (FS section 4.2)."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import character as character_lib
from jaxskills import ground, kinematics
from jaxskills.character import Character
from jaxskills.env.task import TaskSpec
from jaxskills.ground import Shapes
from jaxskills.kinematics import BodyParams, Tree
from jaxskills.motion import CONTROL_DT, Motion
from jaxskills.physics import Physics


@struct.dataclass
class World:
    """What W variants differ by outside of learning. Always of the same shapes for a task."""

    motion: Motion  # [W] the reference on their bodies
    body: BodyParams  # [W]
    shapes: Shapes  # [W]
    model: Any  # what `physics.load` returned


def make(
    character: Character, shown: Motion, spec: TaskSpec, engine: Physics, timestep: float
) -> Callable[[np.ndarray], World]:
    """Returns the function from normalised task parameters `a [W, P]` to their world.

    Args:
      character: who.
      shown: the reference.
      spec: whose conditions are set.
      engine: loads the models.
      timestep: of physics, s.
    """
    conditions = [(i, p) for i, p in enumerate(spec.free) if p.condition is not None]
    level = jax.jit(
        functools.partial(
            _levelled, kinematics.tree(character.model), shown, _physique(character.model)
        )
    )

    @functools.lru_cache(maxsize=1)
    def of(rows: tuple[tuple[float, ...], ...]) -> World:
        models = [compiled(character, spec, np.array(row), timestep) for row in rows]
        physiques = [_physique(model) for model in models]
        body, shapes = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *physiques)
        motions = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(rows), *x.shape)), shown)
        if conditions:
            motions = level(body, shapes)
        return World(motions, body, shapes, engine.load(models))

    # Without conditions all batches have the same world, which is compiled once.
    parameters = [i for i, _ in conditions]
    few = lambda row: tuple(float(v) if i in parameters else 0.0 for i, v in enumerate(row))  # noqa: E731
    return lambda a: of(tuple(few(row) for row in a))


def compiled(
    character: Character, spec: TaskSpec, a: np.ndarray, timestep: float
) -> mujoco.MjModel:
    """Returns the model of a character under the conditions of `a [P]`."""

    def edit(model: mujoco.MjSpec) -> None:
        for parameter, value in zip(spec.free, a, strict=True):
            if parameter.condition is not None:
                low, high = parameter.range
                parameter.condition(model, character, float(low + (high - low) * value))

    return character_lib.compile(character, timestep, edit=edit)


def _physique(model: mujoco.MjModel) -> tuple[BodyParams, Shapes]:
    return kinematics.body_params(model), ground.shapes(model)


def _levelled(
    tree: Tree,
    shown: Motion,
    own: tuple[BodyParams, Shapes],
    body: BodyParams,
    shapes: Shapes,
) -> Motion:
    """Returns the motion of `[W]` other bodies: as far over the ground as on the character's own.

    Longer legs would reach into it, shorter ones hang above.
    """

    def lowest(body: BodyParams, shapes: Shapes) -> jax.Array:
        def one(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
            return jnp.min(ground.clearance(shapes, kinematics.kinematics(tree, body, qpos, qvel)))

        return jax.vmap(one)(shown.qpos, shown.qvel)

    frame = shown.length * CONTROL_DT / (shown.qpos.shape[0] - 1)

    def of(body: BodyParams, shapes: Shapes) -> Motion:
        lift = lowest(*own) - lowest(body, shapes)
        qpos = shown.qpos.at[:, 2].add(lift)
        qvel = shown.qvel.at[:, 2].add(jnp.asarray(jnp.gradient(lift)) / frame)
        return dataclasses.replace(shown, qpos=qpos, qvel=qvel)

    return jax.vmap(of)(body, shapes)
