# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics in jax: everything that follows from `(qpos, qvel)`, for any backend.

The reference and the simulation go through the same function, so they can be compared; the tests
hold it against C MuJoCo. The tree is walked level by level, each level one batched operation.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import pose, rotation


@dataclasses.dataclass(frozen=True)
class Level:
    """Links at one depth. A body with k joints is a chain of k links. All fields `[L]` or so."""

    parent: tuple[int, ...]  # link index, -1 for the world
    body: tuple[int, ...]  # MuJoCo body whose offset this link adds, 0 for none
    joint: tuple[int, ...]  # MuJoCo joint, -1 for none


@dataclasses.dataclass(frozen=True)
class Tree:
    """The static structure: levels of links, and the last link of each of the N bodies.

    The character's only: objects are no bodies here, so neither masses nor places of theirs count.
    """

    layout: pose.Layout
    levels: tuple[Level, ...]
    link_of_body: tuple[int, ...]
    offset_joints: bool  # some joint slides or sits off its body's origin


@struct.dataclass
class BodyParams:
    """The numbers of the bodies and joints; these may differ between variants."""

    pos: jax.Array  # [N+1, 3] m, body offset in its parent, world first
    rot: jax.Array  # [N+1, 3, 3] body orientation in its parent
    anchor: jax.Array  # [J+1, 3] m, joint position in its body, a zero row last
    axis: jax.Array  # [J+1, 3], a zero row last
    mass: jax.Array  # [N] kg
    center: jax.Array  # [N, 3] m, centre of mass in the body frame
    inertia: jax.Array  # [N, 3] kg m^2, principal
    axes: jax.Array  # [N, 3, 3] principal axes in the body frame


@struct.dataclass
class Bodies:
    """Where the N bodies are and how they move, in the world."""

    pos: jax.Array  # [N, 3] m, frame origins
    rot: jax.Array  # [N, 3, 3] rotation matrices
    lin: jax.Array  # [N, 3] m/s, of the frame origins
    ang: jax.Array  # [N, 3] rad/s
    com: jax.Array  # [3] m, of the whole character
    com_vel: jax.Array  # [3] m/s


def tree(model: mujoco.MjModel) -> Tree:
    """Returns the static structure of a compiled model: of its character, without objects."""
    depth, links, last = [], [], {0: -1}
    count, layout = pose.own_bodies(model), pose.Layout.of(model).own
    for body in range(1, count + 1):
        first = int(model.body_jntadr[body])
        joints = list(range(first, first + int(model.body_jntnum[body]))) or [-1]
        parent = last[int(model.body_parentid[body])]
        for number, joint in enumerate(joints):
            links.append((parent, body if number == 0 else 0, joint))
            depth.append(0 if parent < 0 else depth[parent] + 1)
            parent = len(links) - 1
        last[body] = parent
    order = sorted(range(len(links)), key=lambda i: depth[i])
    place = {-1: -1} | {old: new for new, old in enumerate(order)}
    levels = []
    for level in range(max(depth) + 1):
        rows = [links[i] for i in order if depth[i] == level]
        parents, bodies, joints = zip(*rows, strict=True)
        levels.append(Level(tuple(place[p] for p in parents), bodies, joints))
    ends = tuple(place[last[body]] for body in range(1, count + 1))
    slides = any(joint.kind == "slide" for joint in layout.joints)
    beside = model.jnt_pos[: len(layout.joints)].any()
    return Tree(layout, tuple(levels), ends, slides or bool(beside))


def body_params(model: mujoco.MjModel) -> BodyParams:
    """Returns the numbers of a compiled model as float32 arrays, without those of objects."""
    bodies, joints = slice(0, pose.own_bodies(model) + 1), len(pose.Layout.of(model).own.joints)
    with_zero = lambda rows: np.concatenate((rows, np.zeros((1, 3))))  # noqa: E731
    pos, quat = model.body_pos.copy(), model.body_quat.copy()
    # A free joint replaces its body's own offset.
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    pos[free], quat[free] = 0.0, (1.0, 0.0, 0.0, 0.0)
    fields = (
        pos[bodies],
        _matrices(quat[bodies]),
        with_zero(model.jnt_pos[:joints]),
        with_zero(model.jnt_axis[:joints]),
        model.body_mass[bodies][1:],
        model.body_ipos[bodies][1:],
        model.body_inertia[bodies][1:],
        _matrices(model.body_iquat[bodies][1:]),
    )
    return BodyParams(*(jnp.asarray(field, jnp.float32) for field in fields))


def _matrices(quat: np.ndarray) -> np.ndarray:
    matrices = np.zeros((len(quat), 9))
    for row, q in zip(matrices, quat, strict=True):
        mujoco.mju_quat2Mat(row, q)
    return matrices.reshape(-1, 3, 3)


def kinematics(tree: Tree, params: BodyParams, qpos: jax.Array, qvel: jax.Array) -> Bodies:
    """Returns the positions, orientations and velocities of all bodies.

    Args:
      tree: static structure.
      params: numbers of the bodies.
      qpos: `[nq]`.
      qvel: `[nv]`.
    """
    turned, spin, slide, slide_vel = _joint_motions(tree, params, qpos, qvel)
    pos = jnp.zeros((0, 3), qpos.dtype)
    rot, lin, ang = jnp.zeros((0, 3, 3), qpos.dtype), pos, pos
    for level in tree.levels:
        joint, body = np.array(level.joint), np.array(level.body)
        arm, base_rot = params.pos[body], params.rot[body]
        base_pos, base_lin, base_ang = arm, jnp.zeros_like(arm), jnp.zeros_like(arm)
        if level.parent[0] >= 0:
            up = np.array(level.parent)
            arm = rotation.turn(rot[up], arm)
            base_pos, base_rot = pos[up] + arm, rotation.compose(rot[up], base_rot)
            base_lin, base_ang = lin[up] + rotation.cross(ang[up], arm), ang[up]
        new_rot = rotation.compose(base_rot, turned[joint])
        new_ang = base_ang + rotation.turn(new_rot, spin[joint])
        if tree.offset_joints:
            # The joint sits off its body's origin, or slides.
            before = rotation.turn(base_rot, slide[joint] + params.anchor[joint])
            after = rotation.turn(new_rot, params.anchor[joint])
            base_pos += before - after
            base_lin += rotation.cross(base_ang, before) - rotation.cross(new_ang, after)
            base_lin += rotation.turn(base_rot, slide_vel[joint])
        elif level.parent[0] < 0:
            base_pos, base_lin = base_pos + slide[joint], slide_vel[joint]
        pos, rot = jnp.concatenate((pos, base_pos)), jnp.concatenate((rot, new_rot))
        lin, ang = jnp.concatenate((lin, base_lin)), jnp.concatenate((ang, new_ang))
    ends = np.array(tree.link_of_body)
    pos, rot, lin, ang = pos[ends], rot[ends], lin[ends], ang[ends]
    share = params.mass[:, None] / jnp.sum(params.mass)
    arm = rotation.turn(rot, params.center)
    com = jnp.sum(share * (pos + arm), axis=0)
    com_vel = jnp.sum(share * (lin + rotation.cross(ang, arm)), axis=0)
    return Bodies(pos, rot, lin, ang, com, com_vel)


def _joint_motions(
    tree: Tree, params: BodyParams, qpos: jax.Array, qvel: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Returns per joint: turn [J+1,3,3], spin, slide, slide speed [J+1,3]; "no joint" comes last.

    Every column is a gather from `qpos` or `qvel` with a one appended for what is constant.
    """
    joints = tree.layout.joints
    one, zero = len(qpos), len(qpos) + 1
    turn = np.full((len(joints) + 1, 4), zero)
    turn[:, 0] = one
    spin = np.full((len(joints) + 1, 3), len(qvel))
    slide, slide_vel = np.full_like(spin, zero), np.full_like(spin, len(qvel))
    hinges = [i for i, joint in enumerate(joints) if joint.kind == "hinge"]
    for i, joint in enumerate(joints):
        q, d = joint.qpos, joint.dof
        if joint.kind == "free":
            turn[i], spin[i] = range(q + 3, q + 7), range(d + 3, d + 6)
            slide[i], slide_vel[i] = range(q, q + 3), range(d, d + 3)
        elif joint.kind == "ball":
            turn[i], spin[i] = range(q, q + 4), range(d, d + 3)
        elif joint.kind == "hinge":
            turn[i] = one + 2 + 4 * hinges.index(i) + np.arange(4)
            spin[i] = d
        else:
            slide[i], slide_vel[i] = q, d
    scalar = np.array([joint.kind in ("hinge", "slide") for joint in joints] + [False])
    along = jnp.where(scalar[:, None], params.axis, 1.0)
    angle = qpos[np.array([joints[i].qpos for i in hinges], int)]
    about = rotation.exp(params.axis[np.array(hinges, int)] * angle[:, None]).reshape(-1)
    known = jnp.concatenate((qpos, jnp.array([1.0, 0.0], qpos.dtype), about))
    speeds = jnp.concatenate((qvel, jnp.zeros(1, qvel.dtype)))
    matrices = rotation.to_matrix(known[turn])
    return matrices, along * speeds[spin], along * known[slide], along * speeds[slide_vel]


def momentum(params: BodyParams, bodies: Bodies) -> tuple[jax.Array, jax.Array]:
    """Returns linear `[3]` (kg m/s) and angular momentum about the CoM `[3]` (kg m^2/s)."""
    center, velocity, axes, spin = _centers(params, bodies)
    linear = jnp.sum(params.mass) * bodies.com_vel
    orbital = rotation.cross(center - bodies.com, params.mass[:, None] * velocity)
    own = rotation.turn(axes, params.inertia * spin)
    return linear, jnp.sum(orbital + own, axis=0)


def kinetic_energy(params: BodyParams, bodies: Bodies) -> jax.Array:
    """Returns the kinetic energy in the frame of the CoM, in J (SB section 3.3)."""
    _, velocity, _, spin = _centers(params, bodies)
    relative = velocity - bodies.com_vel
    twice = params.mass * jnp.sum(relative**2, -1) + jnp.sum(params.inertia * spin**2, -1)
    return 0.5 * jnp.sum(twice)


def _centers(
    params: BodyParams, bodies: Bodies
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Returns body centres [N,3], their velocities, principal axes [N,3,3], spin in those axes."""
    arm = rotation.turn(bodies.rot, params.center)
    axes = rotation.compose(bodies.rot, params.axes)
    velocity = bodies.lin + rotation.cross(bodies.ang, arm)
    return bodies.pos + arm, velocity, axes, rotation.turn_back(axes, bodies.ang)
