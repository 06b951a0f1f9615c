# SPDX-License-Identifier: Apache-2.0
"""Kinematics, momentum, energy and ground clearance against C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxskills import character, ground, kinematics

CHARACTERS = ("humanoid34", "human21", "atlas")

ODD = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="base" pos="0.1 0.2 1" quat="0.9 0.1 0.2 0.3">
      <freejoint name="base"/>
      <geom type="box" size="0.1 0.2 0.05" pos="0.02 0 0.01" euler="20 30 0" mass="2"/>
      <body name="arm" pos="0.3 0 0" euler="10 40 0">
        <joint name="a" type="hinge" axis="0 1 0" pos="0.05 0 0.02"/>
        <joint name="b" type="hinge" axis="1 0 0.5" pos="0 0.03 0"/>
        <geom type="cylinder" size="0.05 0.2" mass="1"/>
        <body name="slider" pos="0 0 0.3" euler="0 0 70">
          <joint name="s" type="slide" axis="1 1 0"/>
          <geom type="ellipsoid" size="0.05 0.1 0.2" euler="10 50 3" mass="0.7"/>
          <body name="tip" pos="0 0.1 0"><joint name="t" type="ball" pos="0.1 0 0"/>
            <geom type="capsule" size="0.03 0.1" euler="40 0 10" mass="0.3"/></body>
        </body>
      </body>
      <body name="fixed" pos="0 0.2 0.1" euler="5 6 7">
        <geom type="sphere" size="0.08" mass="0.4"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def _model(name, tmp_path):
    if name != "odd":
        return character.load(name).model
    (tmp_path / "odd.xml").write_text(ODD)
    return character.load(str(tmp_path / "odd.xml")).model


def _random_state(model, seed):
    rng = np.random.default_rng(seed)
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(0, 0.8, model.nv), 1.0)
    return qpos, rng.normal(0, 2.0, model.nv)


@pytest.mark.parametrize("name", (*CHARACTERS, "odd"))
def test_bodies_agree_with_the_c_engine(name, tmp_path):
    model = _model(name, tmp_path)
    data = mujoco.MjData(model)
    tree, params = kinematics.tree(model), kinematics.body_params(model)
    for seed in range(3):
        data.qpos[:], data.qvel[:] = _random_state(model, seed)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_energyVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        ours = jax.jit(kinematics.kinematics, static_argnums=0)(
            tree, params, jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32)
        )
        velocity = np.zeros((model.nbody - 1, 6))
        for i in range(1, model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, i, velocity[i - 1], 0)
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5)  # noqa: E731
        close(ours.pos, data.xpos[1:])
        close(ours.rot, data.xmat[1:].reshape(-1, 3, 3))
        close(ours.ang, velocity[:, :3])
        close(ours.lin, velocity[:, 3:])
        mass = model.body_mass.sum()
        close(ours.com, data.subtree_com[1])
        close(ours.com_vel, data.subtree_linvel[1])
        linear, angular = kinematics.momentum(params, ours)
        np.testing.assert_allclose(linear, mass * data.subtree_linvel[1], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(angular, data.subtree_angmom[1], rtol=1e-4, atol=1e-3)
        in_world = kinematics.kinetic_energy(params, ours) + 0.5 * mass * jnp.sum(ours.com_vel**2)
        plain = kinematics.body_params(model)
        armature = 0.5 * np.sum(model.dof_armature * data.qvel**2)
        assert plain.mass.shape == (model.nbody - 1,)
        np.testing.assert_allclose(in_world + armature, data.energy[1], rtol=1e-4)


@pytest.mark.parametrize("name", (*CHARACTERS, "odd"))
def test_clearance_is_where_the_c_engine_sees_contact(name, tmp_path):
    model = _model(name, tmp_path)
    data = mujoco.MjData(model)
    shapes = ground.shapes(model)
    tree, params = kinematics.tree(model), kinematics.body_params(model)
    floor = model.geom("floor").id
    for seed in range(3):
        data.qpos[:], _ = _random_state(model, seed)
        mujoco.mj_kinematics(model, data)
        ours = kinematics.kinematics(tree, params, jnp.asarray(data.qpos), jnp.zeros(model.nv))
        heights = ground.geom_clearance(shapes, ours)
        rows = [g for g in range(model.ngeom) if model.geom_bodyid[g] > 0]
        rows = [g for g in rows if ground._meets_floor(model, g)]
        for geom, height in zip(rows, heights, strict=True):
            distance = mujoco.mj_geomDistance(model, data, geom, floor, 10.0, None)
            np.testing.assert_allclose(height, distance, atol=2e-5)
