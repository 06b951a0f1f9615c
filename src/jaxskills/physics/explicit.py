# SPDX-License-Identifier: Apache-2.0
"""The `discrete` integrator for an engine without it, by a change of the model.

`discrete` solves (M + h D + h^2 K) a = f(q, v) - h K v + J^T f_c, with the damping D and stiffness
K of the servos, and takes the spring of each contact and limit at the end of the step. On a servo
that acts on one joint axis both are diagonal: h D + h^2 K is an armature, and - h K v is a little
more damping. Contacts and limits keep their form under other constants. So Euler steps of the
changed model are `discrete` steps: to rounding without contacts, and nearly so with them, where
the engine's own correction of the contact softness depends on the pose and this one does not.
Springs and dampers that a control switches on, those of hands that hold something, stay as they
are: their forces are those of the beginning of the step.
"""

import copy

import mujoco
import numpy as np

from jaxskills.errors import UserError

_AXES = {0: 6, 1: 3, 2: 1, 3: 1}  # degrees of freedom by mjtJoint: free, ball, slide, hinge


def from_discrete(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a model whose Euler steps are the `discrete` steps of `model`.

    Raises:
      UserError: something in the model is outside of what the change can express.
    """
    _check(model)
    h = model.opt.timestep
    changed = copy.copy(model)
    changed.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    changed.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    kp, kv = -model.actuator_biasprm[:, 1], -model.actuator_biasprm[:, 2]
    changed.actuator_biasprm[:, 2] -= h * kp
    implicit = (_moments(model) ** 2).T @ (h * kv + h * h * kp) + h * model.dof_damping
    changed.dof_armature[:] += implicit
    for reference, impedance in (
        (changed.geom_solref, changed.geom_solimp),
        (changed.pair_solref, changed.pair_solimp),
        (changed.jnt_solref, changed.jnt_solimp),
    ):
        reference[:], impedance[:] = _end_of_step(reference, impedance, h)
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    inertia = _inertia(model)
    changed.dof_invweight0[:] = model.dof_invweight0 * inertia / (inertia + implicit)
    return changed


def _check(model: mujoco.MjModel) -> None:
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    switched = model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE
    if not (on_joint | switched).all():
        raise UserError(
            "backend 'mjx' under 'discrete': only servos on joints, and actuators without a bias,"
            " are supported"
        )
    for field in ("jnt_stiffness", "tendon_stiffness", "tendon_damping"):
        if getattr(model, field).any():
            raise UserError(f"backend 'mjx' under 'discrete': {field} must be 0, use servos")


def _moments(model: mujoco.MjModel) -> np.ndarray:
    """Returns [nu, nv]: the degrees of freedom each servo acts on, times its gear."""
    moments = np.zeros((model.nu, model.nv))
    kinds, joints = model.actuator_trntype, model.actuator_trnid[:, 0]
    for row, kind, joint, gear in zip(moments, kinds, joints, model.actuator_gear, strict=True):
        if kind != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        first, count = model.jnt_dofadr[joint], _AXES[int(model.jnt_type[joint])]
        row[first : first + count] = gear[:count]
    return moments


def _inertia(model: mujoco.MjModel) -> np.ndarray:
    """Returns [nv]: the diagonal of the inertia at the zero pose, which softens joint limits."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return np.diag(full)


def _end_of_step(
    reference: np.ndarray, impedance: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (solref [n, 2], solimp [n, 5]) of constraint springs taken at the end of the step.

    A row a = -b v - k r, both at the end of the step, is a (1 + h b + h^2 k) = -(b + h k) v - k r
    with v and r of its beginning. MuJoCo's k is the one below times the impedance.
    """
    reference, impedance = reference.copy(), impedance.copy()
    hardest = np.clip(impedance[:, 1], 1e-4, 0.9999)
    period, ratio = reference.T
    standard = period > 0
    safe = np.where(standard, period, 1.0)
    b = np.where(standard, 2 / (hardest * safe), -ratio / hardest)
    k = np.where(standard, 1 / (hardest * (safe * ratio) ** 2), -period / hardest)
    scale = 1 + h * b + h * h * k
    softness = (1 - impedance[:, :2]) / impedance[:, :2] / scale[:, None]
    impedance[:, :2] = 1 / (1 + softness)
    hardest = np.clip(impedance[:, 1], 1e-4, 0.9999)
    reference[:, 0] = -k / scale * hardest
    reference[:, 1] = -(b + h * k) / scale * hardest
    return reference, impedance
