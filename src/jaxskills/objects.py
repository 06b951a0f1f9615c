# SPDX-License-Identifier: Apache-2.0
"""Things that move beside a character, such as a box to push or a target to hit.

An object is one more body of the model, beside the character's tree, on slide joints along fixed
axes, without servos. So states, motions, traces and checkpoints carry it like any other joint. What
sums over bodies or joints leaves it out, since `kinematics` and `Layout.own` know the character's
only: an object weighs nothing in a centre of mass and costs nothing in a tracking reward.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills import character as character_lib
from jaxskills import pose, rotation
from jaxskills.character import Character, Object
from jaxskills.errors import UserError, unknown
from jaxskills.kinematics import Bodies
from jaxskills.motion import CONTROL_DT, Motion

_PARKED = 1e-3  # m, an object that is nearer than that to its zero pose is there


class Place(NamedTuple):
    """Where an object is found in poses and velocities, on the host."""

    home: np.ndarray  # [3] m, its origin while its joints are at 0
    axes: np.ndarray  # [k, 3] of its joints
    qpos: np.ndarray  # [k] indices
    dofs: np.ndarray  # [k] displacement indices
    mass: float  # kg


class Scene(NamedTuple):
    """What the objects of a character do in an environment: pure functions of one environment."""

    # (sim, body parameters, phase [], dphase []) -> sim, controls [X]; before each control step
    # that takes dphase. X actuators are the objects', the first ones of the model.
    before: Callable[..., tuple]
    # (qpos [nq], qvel [nv], displacement to the reference [nv], bodies, heading axis [3]) -> [Y]
    observe: Callable[..., jax.Array]


def add(character: Character, motion: Motion, things: Sequence[Object]) -> tuple[Character, Motion]:
    """Returns the character with objects beside it, and its motion with the objects' paths in it.

    Raises:
      UserError: a name that is taken, an object without slide joints of its own in the world, or
        one that moves along a reference that loops.
    """
    if not things:
        return character, motion
    for thing in things:
        taken = (*character.body_names, *(one.name for one in character.objects))
        if thing.name in taken:
            raise UserError(f"object '{thing.name}': a body has that name, give another")
        bare, character = character, _with(character, thing)
        count = len(place(character, thing.name).qpos)
        path = np.zeros((motion.qpos.shape[0], count))
        if thing.path is not None:
            if motion.loop:
                raise UserError(f"object '{thing.name}' moves: give a reference that does not loop")
            path = np.asarray(thing.path(bare, motion), float)
        motion = _along(motion, path)
    return character, motion


def place(character: Character, name: str) -> Place:
    """Returns where an object is found.

    Raises:
      UserError: no such object.
    """
    names = [thing.name for thing in character.objects]
    if name not in names:
        raise unknown(f"object beside {character.name}", name, names)
    model = character.model
    body = model.body(name)
    joints = np.arange(body.jntnum[0]) + body.jntadr[0]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_quat[body.id])
    return Place(
        model.body_pos[body.id].copy(),
        model.jnt_axis[joints] @ turn.reshape(3, 3).T,
        model.jnt_qposadr[joints].copy(),
        model.jnt_dofadr[joints].copy(),
        float(model.body_mass[body.id]),
    )


def position(at: Place, qpos: jax.Array) -> jax.Array:
    """Returns where an object is `[3]` (m) in a pose `[nq]`."""
    return jnp.asarray(at.home, jnp.float32) + qpos[at.qpos] @ jnp.asarray(at.axes, jnp.float32)


def velocity(at: Place, qvel: jax.Array) -> jax.Array:
    """Returns how an object moves `[3]` by a velocity (m/s) or displacement (m) `[nv]`."""
    return qvel[at.dofs] @ jnp.asarray(at.axes, jnp.float32)


def parked(at: Place, qpos: jax.Array) -> jax.Array:
    """Returns whether an object is at its zero pose `[]`."""
    return jnp.all(jnp.abs(qpos[at.qpos]) < _PARKED)


def scene(character: Character, length: float) -> Scene | None:
    """Returns what the objects of a character do along a reference, or None if there are none.

    Args:
      character: who, with its objects.
      length: control frames of the reference.
    """
    if not character.objects:
        return None
    places = [place(character, thing.name) for thing in character.objects]
    acts = [thing.act(character, length) for thing in character.objects if thing.act is not None]

    def before(sim, body, phase: jax.Array, dphase: jax.Array) -> tuple:
        controls = [jnp.zeros(0)]
        for act in acts:
            sim, more = act(sim, body, phase, dphase)
            controls.append(more)
        return sim, jnp.concatenate(controls)

    def observe(
        qpos: jax.Array, qvel: jax.Array, offset: jax.Array, bodies: Bodies, axis: jax.Array
    ) -> jax.Array:
        frame, parts = rotation.heading(bodies.rot[0], axis), []
        for thing, at in zip(character.objects, places, strict=True):
            rows = [position(at, qpos) - bodies.pos[0], velocity(at, qvel)]
            if thing.path is not None:
                rows.append(velocity(at, offset))
            seen = rotation.turn_back(frame, jnp.stack(rows)).reshape(-1)
            parts.append(jnp.where(parked(at, qpos), 0.0, seen) if thing.path is None else seen)
        return jnp.concatenate(parts)

    return Scene(before, observe)


def _with(character: Character, thing: Object) -> Character:
    whole = dataclasses.replace(character, objects=(*character.objects, thing))
    model = character_lib.compile(whole, character_lib.DEFAULT_TIMESTEP)
    whole = dataclasses.replace(whole, model=model, layout=pose.Layout.of(model))
    body = model.body(thing.name)
    joints = whole.layout.joints[len(character.layout.joints) :]
    sliding = len(joints) == body.jntnum[0] > 0 and all(j.kind == "slide" for j in joints)
    if not sliding or body.parentid[0] or body.id <= pose.own_bodies(model):
        raise UserError(f"object '{thing.name}': give it slide joints, in a body of the world")
    return whole


def _along(motion: Motion, path: np.ndarray) -> Motion:
    """Returns the motion with `path [F, k]` after its joints."""
    frame = float(motion.length) * CONTROL_DT / (len(path) - 1)
    speed = np.gradient(path, frame, axis=0)
    both = ((motion.qpos, path), (motion.qvel, speed))
    qpos, qvel = (jnp.concatenate((x, jnp.asarray(y, jnp.float32)), axis=1) for x, y in both)
    return dataclasses.replace(motion, qpos=qpos, qvel=qvel)
