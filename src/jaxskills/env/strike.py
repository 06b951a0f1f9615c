# SPDX-License-Identifier: Apache-2.0
"""A target to hit (FS section 7.1, Punch and SideKick): put where the strike is going to be.

It waits under the floor. Shortly before the phase of the strike the environment puts it where the
hand or foot will be at that phase if it goes on as it does, so far ahead that the surfaces touch
then. So every strike hits, wherever it goes, and what is measured at the phase itself is not yet
disturbed. The momentum of the target afterwards is the impact.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills import character as character_lib
from jaxskills import kinematics, objects, physics, rotation
from jaxskills.character import Character, Object
from jaxskills.compilation import jit
from jaxskills.env import measure as measure_lib
from jaxskills.env.measure import Measure, Moment
from jaxskills.errors import UserError, unknown
from jaxskills.motion import CONTROL_DT, Motion, sample
from jaxskills.physics import servo

_HOME = (0.0, 0.0, -3.0)  # m, where it waits
_SLOWEST = 0.5  # m/s, slower than that nothing is a strike
_WINDOW = 0.1  # of the reference, after the strike, in which it may be hit
_SUBSTEPS = 4  # physics steps in a control step when the reference's own impact is measured


@dataclasses.dataclass(frozen=True)
class Target:
    """A ball in the way of a strike."""

    body: str  # that strikes
    share: float  # of the reference, the phase of the strike: when the body is fastest
    # A bag rather than a ball: the momentum of a light one says no more than how fast the hand is.
    mass: float = 20.0  # kg
    # Half as large, hard strikes miss it: they turn by 0.1 m in a control step.
    radius: float = 0.2  # m
    lead: float = 1.0  # control steps before the strike when it is put there, at most
    name: str = "target"


def target(config: Target) -> Object:
    """Returns the target as an object.

    Raises:
      UserError: a value out of range. A body that is none is found when it is added.
    """
    validate(config)
    return Object(
        config.name,
        lambda spec: _build(config, spec),
        act=lambda character, length: _act(config, character, length),
    )


def impact(config: Target, until: float | None = None) -> Measure:
    """Returns the measure of the impact: the target's largest momentum (kg m/s) after the strike.

    The reference is poses and hits nothing. Its own impact, 1 in multiples of the reference, is
    that of the character in the simulation: it starts on the reference where the target is put,
    follows it with its servos and no other help, and hits. Unlike an effective mass times a speed,
    that has in it what the servos push, and is what a performance is measured by.

    Args:
      config: the target.
      until: share of the reference at which the impact is known; None: 0.1 after the strike.
    """

    def quantity(character: Character):
        at = objects.place(character, config.name)
        return lambda moment: at.mass * jnp.linalg.norm(objects.velocity(at, _speeds(moment)))

    end = min(1.0, config.share + _WINDOW) if until is None else until
    made = measure_lib.largest(quantity, max(0.0, config.share - _WINDOW), end)
    return made._replace(reference=functools.partial(reference_impact, config, end))


def reference_impact(config: Target, end: float, character: Character, motion: Motion) -> float:
    """Returns the impact (kg m/s) of the character that follows `motion`, see `impact`.

    Args:
      config: the target.
      end: share of the reference until which it counts.
      character: with the target.
      motion: the reference.
    """
    length, at = float(motion.length), objects.place(character, config.name)
    scene = objects.scene(character, length)
    assert scene is not None
    engine = physics.make("cpu", 1, num_envs=1, threads=1)
    model = engine.load([character_lib.compile(character, CONTROL_DT / _SUBSTEPS)])
    layout, servos = character.layout, servo.of(character)
    body, variant = kinematics.body_params(character.model), jnp.int32(0)

    def step(sim, phase: jax.Array):
        sim, more = scene.before(sim, body, phase, jnp.float32(1.0))
        goal, speed = sample(layout, motion, phase + 1.0)

        def substep(sim, _: None):
            ctrl = servo.controls(servos, layout, sim, goal, speed, CONTROL_DT / _SUBSTEPS)
            return engine.step(model, variant, sim, jnp.concatenate((more, ctrl))), None

        sim, _ = jax.lax.scan(substep, sim, None, length=_SUBSTEPS)
        return sim, at.mass * jnp.linalg.norm(objects.velocity(at, sim.qvel))

    first = max(config.share * length - config.lead, 0.0)
    phases = first + np.arange(max(1, math.ceil(end * length - first)))

    def simulate() -> jax.Array:
        begin = engine.init(model, variant, *sample(layout, motion, jnp.float32(first)))
        return jnp.max(jax.lax.scan(step, begin, jnp.asarray(phases, jnp.float32))[1])

    return float(jit(simulate)())


def _speeds(moment: Moment) -> jax.Array:
    assert moment.qvel is not None
    return moment.qvel


def _build(config: Target, spec: mujoco.MjSpec) -> None:
    struck = spec.body(config.body)
    if struck is None:
        names = [body.name for body in spec.bodies[1:]]
        raise unknown("body that strikes", config.body, names)
    body = spec.worldbody.add_body(name=config.name, pos=list(_HOME), gravcomp=1.0)
    for axis, name in enumerate("xyz"):
        way = np.eye(3)[axis]
        kind = mujoco.mjtJoint.mjJNT_SLIDE
        body.add_joint(name=f"{config.name}_{name}", type=kind, axis=way)
    body.add_geom(
        name=config.name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[config.radius, 0.0, 0.0],
        mass=config.mass,
        contype=0,
        conaffinity=0,
        rgba=[0.75, 0.25, 0.2, 1.0],
    )
    for number, geom in enumerate(struck.geoms):
        geom.name = geom.name or f"{config.body}_{number}"
        spec.add_pair(geomname1=config.name, geomname2=geom.name, condim=3)


def _act(config: Target, character: Character, length: float):
    """Returns what puts the target in the way, once, as long as it waits."""
    tree, at = kinematics.tree(character.model), objects.place(character, config.name)
    row, apart = character.body(config.body), config.radius + _reach(character, config.body)
    home = jnp.asarray(at.home, jnp.float32)

    def act(sim, body, phase: jax.Array, dphase: jax.Array):
        left = (config.share * length - phase) / dphase  # control steps
        bodies = kinematics.kinematics(tree, body, sim.qpos, sim.qvel)
        arm = rotation.turn(bodies.rot[row], body.center[row])
        velocity = bodies.lin[row] + rotation.cross(bodies.ang[row], arm)
        speed = jnp.linalg.norm(velocity)
        way = velocity / jnp.maximum(speed, _SLOWEST)
        point = bodies.pos[row] + arm + velocity * left * CONTROL_DT + apart * way
        now = objects.parked(at, sim.qpos) & (left > 0.0) & (left <= config.lead)
        now &= speed > _SLOWEST
        qpos = jnp.where(now, sim.qpos.at[at.qpos].set((point - home) @ at.axes.T), sim.qpos)
        qvel = jnp.where(now, sim.qvel.at[at.dofs].set(0.0), sim.qvel)
        return dataclasses.replace(sim, qpos=qpos, qvel=qvel), jnp.zeros(0)

    return act


def _reach(character: Character, name: str) -> float:
    """Returns how far a body's geoms reach from its centre of mass (m), at most."""
    model = character.model
    body = model.body(name).id
    rows = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and _hits(model, g)]
    apart = np.linalg.norm(model.geom_pos[rows] - model.body_ipos[body], axis=1)
    return float((apart + model.geom_rbound[rows]).max())


def _hits(model: mujoco.MjModel, geom: int) -> bool:
    return geom in model.pair_geom1 or geom in model.pair_geom2


def validate(config: Target) -> None:
    """Checks a target.

    Raises:
      UserError: a value out of range.
    """
    if not 0 < config.share < 1:
        raise UserError(f"target.share is {config.share}: give a phase between 0 and 1")
    for name in ("mass", "radius"):
        if not 0 < getattr(config, name) < math.inf:
            raise UserError(f"target.{name} is {getattr(config, name)}: give a number above 0")
    if not 1 <= config.lead <= 30:
        raise UserError(f"target.lead is {config.lead}: give 1 to 30 control steps")
