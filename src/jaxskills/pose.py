# SPDX-License-Identifier: Apache-2.0
"""The pose manifold: poses are MuJoCo `qpos`, displacements its tangent with `nv` numbers.

The same three functions give the target of the servos (SB fig. 4), motion displacement (FS eq. 2),
the errors of bounds and rewards, and interpolation. A free joint's displacement is linear in the
world and angular in its own frame; a ball joint's is angular in its own frame.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills import rotation

KINDS = {
    mujoco.mjtJoint.mjJNT_FREE: "free",
    mujoco.mjtJoint.mjJNT_BALL: "ball",
    mujoco.mjtJoint.mjJNT_SLIDE: "slide",
    mujoco.mjtJoint.mjJNT_HINGE: "hinge",
}


@dataclasses.dataclass(frozen=True)
class Joint:
    """One joint: its kind ('free', 'ball', 'hinge', 'slide') and first addresses."""

    name: str
    kind: str
    qpos: int
    dof: int

    @property
    def dofs(self) -> range:
        """The displacement indices of this joint."""
        width = {"free": 6, "ball": 3}.get(self.kind, 1)
        return range(self.dof, self.dof + width)


@dataclasses.dataclass(frozen=True)
class Layout:
    """How `qpos [nq]` and displacements `[nv]` are laid out. Static and hashable."""

    joints: tuple[Joint, ...]
    nq: int
    nv: int
    others: int = 0  # how many joints at the end are no joints of the character, but of objects

    @property
    def own(self) -> "Layout":
        """The layout of the character alone; its indices hold in whole poses too."""
        if not self.others:
            return self
        first = self.joints[-self.others]
        return Layout(self.joints[: -self.others], first.qpos, first.dof)

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Layout":
        """Returns the layout of a compiled model."""
        joints = tuple(
            Joint(
                model.joint(i).name,
                KINDS[mujoco.mjtJoint(int(model.jnt_type[i]))],
                int(model.jnt_qposadr[i]),
                int(model.jnt_dofadr[i]),
            )
            for i in range(model.njnt)
        )
        others = int((model.jnt_bodyid > own_bodies(model)).sum())
        return cls(joints, model.nq, model.nv, others)


def own_bodies(model: mujoco.MjModel) -> int:
    """Returns N, how many bodies are the character's; bodies after those are objects.

    The character is the tree that the first joint belongs to. MuJoCo keeps trees together, so its
    bodies are 1 to N, with what stands fixed before it in the file.
    """
    if not model.njnt:
        return model.nbody - 1
    root = model.body_rootid[model.jnt_bodyid[0]]
    return int(np.flatnonzero(model.body_rootid == root)[-1])


def _addresses(layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns (quaternion qpos [Q,4], their dofs [Q,3], other qpos [S], their dofs [S])."""
    quat_q, quat_d, other_q, other_d = [], [], [], []
    for joint in layout.joints:
        q, d = joint.qpos, joint.dof
        if joint.kind == "free":
            other_q += [q, q + 1, q + 2]
            other_d += [d, d + 1, d + 2]
            q, d = q + 3, d + 3
        if joint.kind in ("free", "ball"):
            quat_q.append(range(q, q + 4))
            quat_d.append(range(d, d + 3))
        else:
            other_q.append(q)
            other_d.append(d)
    as_int = lambda rows, width: np.array(rows, np.int32).reshape((-1, *width))  # noqa: E731
    return as_int(quat_q, (4,)), as_int(quat_d, (3,)), as_int(other_q, ()), as_int(other_d, ())


def _gather(x: jax.Array, index: np.ndarray) -> jax.Array:
    return x[..., index.reshape(-1)].reshape((*x.shape[:-1], *index.shape))


def _merge(parts: tuple[jax.Array, jax.Array], index: tuple[np.ndarray, np.ndarray]) -> jax.Array:
    """Puts quaternion-joint and scalar-joint numbers back into one vector, by a gather."""
    flat = jnp.concatenate((parts[0].reshape((*parts[1].shape[:-1], -1)), parts[1]), axis=-1)
    order = np.argsort(np.concatenate((index[0].reshape(-1), index[1])))
    return flat[..., order]


def plus(layout: Layout, qpos: jax.Array, d: jax.Array) -> jax.Array:
    """Returns the pose `[..., nq]` reached from `qpos` by the displacement `d [..., nv]`.

    FS eq. 2: positions add, rotations are q exp(d).
    """
    quat_q, quat_d, other_q, other_d = _addresses(layout)
    quats = rotation.mul(_gather(qpos, quat_q), rotation.exp(_gather(d, quat_d)))
    return _merge((quats, qpos[..., other_q] + d[..., other_d]), (quat_q, other_q))


def minus(layout: Layout, a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns the displacement `[..., nv]` that leads from pose `b` to pose `a` (`[..., nq]`)."""
    quat_q, quat_d, other_q, other_d = _addresses(layout)
    turned = rotation.log(rotation.mul(rotation.inv(_gather(b, quat_q)), _gather(a, quat_q)))
    return _merge((turned, a[..., other_q] - b[..., other_q]), (quat_d, other_d))


def lerp(layout: Layout, a: jax.Array, b: jax.Array, t: jax.Array) -> jax.Array:
    """Returns the pose a share `t [...]` of the way from `a` to `b` (`[..., nq]`)."""
    return plus(layout, a, jnp.asarray(t)[..., None] * minus(layout, b, a))


def normalize(layout: Layout, qpos: jax.Array) -> jax.Array:
    """Returns `qpos [..., nq]` with its quaternions at unit norm."""
    quat_q, _, other_q, _ = _addresses(layout)
    return _merge(
        (rotation.normalize(_gather(qpos, quat_q)), qpos[..., other_q]), (quat_q, other_q)
    )


def rotation_vectors(layout: Layout, qpos: jax.Array) -> jax.Array:
    """Returns the joint coordinates `[..., nv]`: rotation vectors for quaternions, else values.

    These are the coordinates in which position servos measure a joint (SB: exponential maps).
    """
    quat_q, quat_d, other_q, other_d = _addresses(layout)
    return _merge((rotation.log(_gather(qpos, quat_q)), qpos[..., other_q]), (quat_d, other_d))
