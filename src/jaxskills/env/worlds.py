# SPDX-License-Identifier: Apache-2.0
"""Bodies and physics of a batch of task parameters, compiled on the host (FS section 4.2)."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import ground, kinematics, levels
from jaxskills.character import Character
from jaxskills.env import holds as holds_lib
from jaxskills.env import task as task_lib
from jaxskills.env.holds import Holds
from jaxskills.env.task import TaskSpec
from jaxskills.ground import Shapes
from jaxskills.kinematics import BodyParams
from jaxskills.motion import Motion
from jaxskills.physics import Physics


@struct.dataclass
class World:
    """What W variants differ by outside of learning. Always of the same shapes for a task."""

    motion: Motion  # [W] the reference on their bodies
    body: BodyParams  # [W]
    shapes: Shapes  # [W]
    holds: Holds | None  # [W]
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
    conditions = [i for i, p in enumerate(spec.free) if p.condition is not None]
    tree = kinematics.tree(character.model)
    level = jax.jit(functools.partial(levels.of_variants, tree, shown, _own(character.model)[:2]))

    @functools.lru_cache(maxsize=1)
    def of(rows: tuple[tuple[float, ...], ...]) -> World:
        made = functools.partial(task_lib.variant, spec, character, timestep=timestep)
        models = [made(np.array(row)).model for row in rows]
        own = [_own(model) for model in models]
        body, shapes, holds = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *own)
        motions = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(rows), *x.shape)), shown)
        if conditions:
            motions = level((body, shapes))
        return World(motions, body, shapes, holds, engine.load(models))

    # Without conditions all batches have the same world, which is compiled once.
    few = lambda row: tuple(float(v) if i in conditions else 0.0 for i, v in enumerate(row))  # noqa: E731
    return lambda a: of(tuple(few(row) for row in a))


def _own(model: mujoco.MjModel) -> tuple[BodyParams, Shapes, Holds | None]:
    return kinematics.body_params(model), ground.shapes(model), holds_lib.of(model)
