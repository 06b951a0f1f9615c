# SPDX-License-Identifier: Apache-2.0
"""How good an episode's motion is, whatever its task: near the reference, no slipping (FS eq. 10).

Episodes are compared with the reference at knots one control frame of phase apart. Nothing here
depends on where the episode takes place or which way it faces, only on joints, heights over the
ground and how far bodies slip, so there is nothing to align.
"""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import ground, kinematics, pose
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.kinematics import BodyParams, Tree
from jaxskills.motion import Motion, sample
from jaxskills.trace import neighbours, usable

_AXES = 57  # of joints, that the scales of FitnessConfig are for


@dataclasses.dataclass(frozen=True)
class FitnessConfig:
    """Scales sigma of FS eq. 10, for sums over joints or bodies and means over phase.

    Sums grow with the character. The first two numbers are printed for 57 axes of joints: 2.67^2 =
    57 / 8, 75.5^2 = 57 * 100, with 8 and 0.01 the factors of means in the authors' code. Their
    squares count in proportion to the axes of the character, so that all are judged alike.
    """

    pose: float = 2.67  # rad
    velocity: float = 75.5  # of errors relative to the reference's speed
    # FS prints 1.3 and 0.7, without a unit. In m both would be blind: feet 0.1 m off the floor all
    # along a jump cost 0.01, slipping at 0.9 m/s less. In dm they cost 0.7 and 0.3 there, about
    # as in the authors' code (0.4 and 0.5).
    contact: float = 0.13  # m
    drag: float = 0.07  # m in a control frame of phase
    slow: float = 0.5  # rad^2/s^2, V: joints slower than its root count as that fast
    constraint: float = 0.1  # weight of the constraints' reward
    contact_height: float = 0.03  # m, a body of the reference lower than that touches the ground


@struct.dataclass
class Measures:
    """What fitness looks at, at N knots, of E bodies."""

    qpos: jax.Array  # [N, nq]; in this and the next, what comes after the character's own is unread
    qvel: jax.Array  # [N, nv] per second
    height: jax.Array  # [N, E] m, lowest points over the ground
    place: jax.Array  # [N, E, 2] m, where the bodies are horizontally


@struct.dataclass
class Fitness:
    """The factors, each in [0, 1], and F of FS eq. 10."""

    pose: jax.Array  # []
    velocity: jax.Array  # []
    contact: jax.Array  # []
    drag: jax.Array  # []
    likeness: jax.Array  # [] their product
    total: jax.Array  # [] with the constraints' share on top


# (qpos [T, nq], qvel [T, nv], phase [T], valid [T], constraint []) of one episode, and the bodies
# and shapes it was performed with, unless they are the reference's
Judge = Callable[..., Fitness]


def make(character: Character, motion: Motion, config: FitnessConfig) -> Judge:
    """Returns the function that judges one episode by the reference `motion`; `vmap` it for more.

    The ground that heights are over is the floor and what stands on it, for the reference that of
    the character's model. The rows are those of `trace.trace_to_variation`; `constraint` is
    r_constraint in [0, 1], 0 if there is none. An episode that ends early is judged as if it stood
    still: have its coverage checked. One without any usable row is worth nothing.
    """
    validate(config)
    tree, params = kinematics.tree(character.model), kinematics.body_params(character.model)
    shapes, layout = ground.shapes(character.model), character.layout.own
    bodies = contact_bodies(character, shapes)
    knots = phases(motion)

    @jit
    def of_reference() -> Measures:
        # At its very end a motion is at rest, which an episode on its way past it is not.
        inside = jnp.minimum(knots, jnp.nextafter(motion.length, jnp.zeros_like(motion.length)))
        rows = jax.vmap(lambda phase: sample(layout, motion, phase))(inside)
        return measure(tree, params, shapes, bodies, *rows)

    reference = of_reference()

    def judge(
        qpos: jax.Array,
        qvel: jax.Array,
        phase: jax.Array,
        valid: jax.Array,
        constraint: jax.Array,
        own: tuple[BodyParams, ground.Shapes] | None = None,
    ) -> Fitness:
        valid = usable(valid, qpos, qvel, phase)
        # Rows that are not used must be numbers all the same: row 0 stands in if there is none.
        qpos = jnp.where(valid[:, None], qpos, motion.qpos[0])
        qvel = jnp.where(valid[:, None], qvel, 0.0)
        near = neighbours(jnp.where(valid, phase, 0.0), valid, knots)
        at = pose.lerp(layout, qpos[near.low], qpos[near.high], near.share)
        speed = qvel[near.low] + near.share[:, None] * (qvel[near.high] - qvel[near.low])
        seen = measure(tree, *(own or (params, shapes)), bodies, at, speed)
        found = fitness(config, layout, reference, seen, constraint)
        return jax.tree.map(lambda one: jnp.where(valid.any(), one, 0.0), found)

    return judge


def phases(motion: Motion) -> jax.Array:
    """Returns the knots `[N]`, one a control frame from 0 to the motion's length, on the host."""
    return jnp.linspace(0.0, motion.length, max(round(float(motion.length)), 1) + 1)


def contact_bodies(character: Character, shapes: ground.Shapes) -> tuple[int, ...]:
    """Returns the bodies whose contacts count: end effectors, and those made to touch the ground.

    The latter are the toes besides the feet, as in the authors' code.
    """
    names = (*character.end_effectors, *character.ground)
    bodies = dict.fromkeys(character.body(name) for name in names)
    return tuple(body for body in bodies if body in shapes.body)


def measure(
    tree: Tree,
    params: BodyParams,
    shapes: ground.Shapes,
    bodies: tuple[int, ...],
    qpos: jax.Array,
    qvel: jax.Array,
) -> Measures:
    """Returns what fitness looks at in states `qpos [N, nq]`, `qvel [N, nv]`."""
    rows = np.array(bodies, int)

    def one(qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = kinematics.kinematics(tree, params, qpos, qvel)
        return ground.clearance(shapes, seen)[rows], seen.pos[rows, :2]

    return Measures(qpos, qvel, *jax.vmap(one)(qpos, qvel))


def fitness(
    config: FitnessConfig,
    layout: pose.Layout,
    reference: Measures,
    episode: Measures,
    constraint: jax.Array,
) -> Fitness:
    """Returns F of FS eq. 10 and its factors.

    The joints are all but the root, which may turn and travel as a task demands. Velocities are
    those per second: a performance at another speed counts as a fault, a small one.

    Args:
      config: scales.
      layout: of the character's own joints.
      reference: of `m_0`.
      episode: at the same N knots.
      constraint: `[]` r_constraint in [0, 1].
    """
    count = reference.qpos.shape[0]
    offset = pose.minus(layout, reference.qpos, episode.qpos)[:, 6:]
    joint = _joints(layout)
    fast = reference.qvel[:, 6 : layout.nv] ** 2 @ joint
    astray = (reference.qvel - episode.qvel)[:, 6 : layout.nv] ** 2 @ joint
    touching = reference.height < config.contact_height
    stays = touching[1:] & touching[:-1]
    slipped = jnp.sum((episode.place[1:] - episode.place[:-1]) ** 2, -1)
    lifted = (reference.height - episode.height) ** 2
    size = math.sqrt(offset.shape[-1] / _AXES)
    errors = (
        (size * config.pose, offset**2),
        (size * config.velocity, astray / jnp.maximum(config.slow, fast)),
        (config.contact, jnp.where(touching, lifted, 0.0)),
        (config.drag, jnp.where(stays, slipped, 0.0)),
    )
    factors = [jnp.exp(-jnp.sum(error) / count / scale**2) for scale, error in errors]
    likeness = jnp.prod(jnp.stack(factors))
    total = likeness + config.constraint * constraint
    return Fitness(*factors, likeness=likeness, total=total)


def validate(config: FitnessConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    for name in ("pose", "velocity", "contact", "drag", "slow"):
        if not 0 < getattr(config, name) < math.inf:
            raise UserError(f"fitness.{name} is {getattr(config, name)}: give a number above 0")
    if not 0 <= config.constraint <= 1:
        raise UserError(f"fitness.constraint is {config.constraint}: give 0 to 1")
    if not -1 <= config.contact_height <= 1:
        raise UserError(f"fitness.contact_height is {config.contact_height}: give -1 to 1 m")


def _joints(layout: pose.Layout) -> np.ndarray:
    """Returns the matrix `[nv - 6, J]` that sums over the axes of each joint but the root."""
    matrix = np.zeros((layout.nv - 6, len(layout.joints) - 1), np.float32)
    for column, joint in enumerate(layout.joints[1:]):
        matrix[np.array(joint.dofs) - 6, column] = 1.0
    return matrix
