# SPDX-License-Identifier: Apache-2.0
"""A toy model, plain C loops, and the backends ready to be compared with them."""

import dataclasses
import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxskills import physics
from jaxskills.compilation import jit
from jaxskills.physics import cpu

SUBSTEPS = 4
ROWS = 6
VARIANT = np.array([0, 1, 2, 0, 1, 2], np.int32)
PLAIN = np.zeros(ROWS, np.int32)

TOY = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 {gravity}" iterations="8">
    <flag autoreset="{autoreset}"/>
  </option>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/>
    <body name="trunk" pos="0 0 0.3">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.1" mass="{mass}" contype="0" conaffinity="0"/>
      <body name="arm" pos="0.1 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0" mass="0.5" contype="0"
          conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <contact><pair geom1="floor" geom2="ball" condim="3"/></contact>
  <actuator>
    <position joint="elbow" kp="5" kv="0.2"/>
    <motor joint="elbow" gear="1"/>
  </actuator>
</mujoco>
"""


def toy(mass: float = 2.0, gravity: float = -9.81, autoreset: str = "disable") -> mujoco.MjModel:
    """A ball with an arm above a floor: 8 coordinates, 7 velocities, 2 controls."""
    text = TOY.format(mass=mass, gravity=gravity, autoreset=autoreset)
    return mujoco.MjModel.from_xml_string(text)


@dataclasses.dataclass
class Case:
    """A backend with three variants loaded, and its step compiled once for `ROWS` rows."""

    name: str
    engine: physics.Physics
    models: list[mujoco.MjModel]
    loaded: Any
    init: Any
    step: Any

    def start(self, qpos: np.ndarray, qvel: np.ndarray, variant: Any = VARIANT) -> physics.SimState:
        """Returns the state of `ROWS` environments."""
        return self.init(self.loaded, variant, jnp.asarray(qpos), jnp.asarray(qvel))


def make_case(name: str, models: list[mujoco.MjModel]) -> Case:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(cpu.CALLBACK_VARIABLE, "1" if name == "callback" else "0")
        backend = "cpu" if name == "callback" else name
        engine = physics.make(backend, SUBSTEPS, num_envs=ROWS)
    return Case(
        name=name,
        engine=engine,
        models=models,
        loaded=engine.load(models),
        init=jit(jax.vmap(engine.init, (None, 0, 0, 0))),
        step=jit(jax.vmap(engine.step, (None, 0, 0, 0))),
    )


@functools.cache
def shared_case(name: str) -> Case:
    """The backend with models that differ in mass and in gravity, compiled once for all tests."""
    return make_case(name, [toy(), toy(mass=3.0), toy(gravity=-1.6)])


def inputs(rows: int = ROWS, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """float32 qpos [rows, 8], qvel [rows, 7], ctrl [12, rows, 2]: it falls, bounces and swings."""
    random = np.random.default_rng(seed)
    qpos = np.tile(toy().qpos0, (rows, 1))
    qpos[:, 2] = random.uniform(0.11, 0.2, rows)
    qpos[:, 7] = random.uniform(-1, 1, rows)
    qvel = random.normal(size=(rows, 7)) * 0.5
    ctrl = random.normal(size=(12, rows, 2))
    return tuple(np.asarray(x, np.float32) for x in (qpos, qvel, ctrl))  # type: ignore


def c_loop(model: mujoco.MjModel, qpos, qvel, ctrls, substeps: int = SUBSTEPS) -> np.ndarray:
    """Returns (qpos, qvel) after plain `mj_step`, carried as float32 between control steps."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    for ctrl in ctrls:
        data.ctrl[:] = ctrl
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        for field in (data.qpos, data.qvel, data.qacc_warmstart):
            field[:] = field.astype(np.float32)
    return np.concatenate([data.qpos, data.qvel])


def flat(state: physics.SimState) -> np.ndarray:
    """Returns [rows, nq + nv]."""
    return np.concatenate([np.asarray(state.qpos), np.asarray(state.qvel)], axis=-1)


def bits(state: physics.SimState) -> bytes:
    """Returns the whole state as bytes."""
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state))


def run_alone(script: str, tmp_path: Path, **variables: str) -> str:
    """Runs Python code in a fresh process, two minutes at most; returns what it printed."""
    source = str(Path(physics.__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": f"{source}:{Path(__file__).parent}", **variables}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
