# SPDX-License-Identifier: Apache-2.0
"""A box to push along x (FS section 7.1, Push): it slides on the floor, and hands stick to it.

The box cannot turn or lift off: its one joint slides along x, with the floor's friction in the
joint. Hands stick by MuJoCo's adhesion: while the phase is right, each is drawn to the box with a
constant force as soon as it is near (and to whatever else it touches), and friction keeps it where
it touched. Nothing has to be remembered, so an episode may begin in any phase; what pulls harder
than the force comes loose.
"""

import dataclasses
import math
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills import kinematics, objects
from jaxskills.character import Character, Object
from jaxskills.compilation import jit
from jaxskills.env.measure import Moment, Quantity
from jaxskills.env.task import Condition
from jaxskills.errors import UserError, unknown
from jaxskills.motion import Motion

_HAND_FRICTION, _BODY_FRICTION = 1.0, 0.5
_HARD = [0.95, 0.99, 0.001, 0.5, 2.0]  # solimp: the grip presses a hand 1 mm into the box, not 5
_FLOOR_GAP = 0.005  # m, so that nothing is drawn into the floor


@dataclasses.dataclass(frozen=True)
class Box:
    """A box and its hands. Phases are shares of the reference."""

    hands: tuple[str, ...]  # bodies that stick to it
    begin: float  # phase from which on hands stick and the reference's box moves with them
    end: float  # and until when
    face: float  # m, x of the face towards the hands before it is pushed
    size: tuple[float, float, float] = (1.0, 1.0, 1.4)  # m, length, width, height
    mass: float = 18.0  # kg, FS section 7.1
    friction: float = 0.3  # between box and floor, what the clip `push` is made for
    near: float = 0.01  # m, how far away a hand is drawn to the box
    # What each hand is drawn with: no less than an arm pulls with, and no more, for it slaps on.
    grip: float = 300.0  # N
    name: str = "box"


def box(config: Box) -> Object:
    """Returns the box as an object that goes with the hands of the reference.

    Raises:
      UserError: a value out of range. A hand that is no body is found when it is added.
    """
    validate(config)
    return Object(
        config.name,
        lambda spec: _build(config, spec),
        lambda character, motion: _path(config, character, motion),
        lambda character, length: _stick(config, length),
    )


def mass(config: Box) -> Condition:
    """Returns the condition that multiplies the mass of the box, and its friction with it."""

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        body = spec.body(config.name)
        if body is None:
            names = [thing.name for thing in character.objects]
            raise unknown(f"object beside {character.name}", config.name, names)
        for geom in body.geoms:
            geom.mass *= factor
        for joint in body.joints:
            joint.frictionloss *= factor

    return change


def travel(config: Box) -> Quantity:
    """m, how far the box is from where it stood."""

    def quantity(character: Character):
        row = objects.place(character, config.name).qpos[0]
        return lambda moment: _pose(moment)[row]

    return quantity


def _pose(moment: Moment) -> jax.Array:
    assert moment.qpos is not None
    return moment.qpos


def _build(config: Box, spec: mujoco.MjSpec) -> None:
    length, width, height = config.size
    middle = [config.face + length / 2, 0.0, height / 2 + _FLOOR_GAP]
    weight = config.mass * float(np.linalg.norm(spec.option.gravity))
    body = spec.worldbody.add_body(name=config.name, pos=middle)
    slide = mujoco.mjtJoint.mjJNT_SLIDE
    loss = config.friction * weight
    body.add_joint(name=config.name, type=slide, axis=[1, 0, 0], frictionloss=loss)
    body.add_geom(
        name=config.name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[length / 2, width / 2, height / 2],
        mass=config.mass,
        contype=0,
        conaffinity=0,
        rgba=[0.78, 0.62, 0.42, 1.0],
    )
    touching = list(_colliding(spec, spec.joints[0].parent))
    bodies = dict.fromkeys(name for name, _ in touching)
    for hand in config.hands:
        if hand not in bodies:
            raise unknown("body that pushes", hand, bodies)
    for name, geom in touching:
        near = config.near if name in config.hands else 0.0
        slip = _HAND_FRICTION if name in config.hands else _BODY_FRICTION
        friction = [slip, slip, 0.005, 0.0001, 0.0001]
        pair = {"geomname1": config.name, "geomname2": geom.name, "condim": 3}
        spec.add_pair(**pair, friction=friction, margin=0.0, gap=near, solimp=_HARD)
    for hand in config.hands:
        actuator = spec.add_actuator(name=f"{config.name}_{hand}", target=hand, ctrlrange=[0, 1])
        actuator.trntype = mujoco.mjtTrn.mjTRN_BODY
        actuator.set_to_adhesion(gain=config.grip)


def _colliding(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> Iterator[tuple[str, mujoco.MjsGeom]]:
    """Yields the geoms that touch something, each with its body's name, from a body on down."""
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for number, geom in enumerate(body.geoms):
        geom.name = geom.name or f"{body.name}_{number}"
        if geom.contype or geom.conaffinity or geom.name in paired:
            yield body.name, geom
    for child in body.bodies:
        yield from _colliding(spec, child)


def _path(config: Box, character: Character, motion: Motion) -> np.ndarray:
    """Returns how far the reference's hands have pushed `[F, 1]`: their mean, never back."""
    tree, params = kinematics.tree(character.model), kinematics.body_params(character.model)
    rows = np.array([character.body(name) for name in config.hands])

    def look(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        return jnp.mean(kinematics.kinematics(tree, params, qpos, qvel).pos[rows, 0])

    along = np.asarray(jit(jax.vmap(look))(motion.qpos, motion.qvel), float)
    share = np.linspace(0.0, 1.0, len(along))
    during = np.interp(np.clip(share, config.begin, config.end), share, along)
    return np.maximum.accumulate(during - during[0])[:, None]


def _stick(config: Box, length: float):
    """Returns what turns adhesion on while the phase is right."""

    def act(sim, body, phase: jax.Array, dphase: jax.Array):
        share = phase / length
        now = (config.begin <= share) & (share < config.end)
        return sim, jnp.full(len(config.hands), now, jnp.float32)

    return act


def validate(config: Box) -> None:
    """Checks a box.

    Raises:
      UserError: a value out of range.
    """
    if not config.hands:
        raise UserError("box.hands is empty: name the bodies that push")
    if not 0 <= config.begin < config.end <= 1:
        raise UserError(
            f"box.begin is {config.begin}, box.end {config.end}: give 0 <= begin < end <= 1"
        )
    for name, values in (("size", config.size), ("mass", (config.mass,))):
        if not all(0 < value < math.inf for value in values):
            raise UserError(f"box.{name} is {getattr(config, name)}: give numbers above 0")
    for name in ("friction", "near", "grip"):
        if not 0 <= getattr(config, name) < math.inf:
            raise UserError(f"box.{name} is {getattr(config, name)}: give 0 or more")
