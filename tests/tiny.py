# SPDX-License-Identifier: Apache-2.0
"""A walker of four bodies and its walk: every kind of joint, and quick to compile."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache as jax_cache

from jaxskills import character, clip, motion
from jaxskills import physics as physics_lib
from jaxskills.character import Character
from jaxskills.clip import data as clip_data
from jaxskills.env import bounds, core, variants
from jaxskills.learn.networks import NetworkConfig
from jaxskills.learn.ppo import PPOConfig
from jaxskills.motion import Motion
from jaxskills.physics import Physics
from jaxskills.physics.base import SimState, start
from jaxskills.trainer import TrainConfig

_XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="pelvis" pos="0 0 0.5">
      <freejoint name="root"/>
      <geom type="box" size="0.05 0.12 0.05" mass="3"/>
      <body name="torso" pos="0 0 0.08">
        <joint name="spine" type="ball"/>
        <geom type="capsule" fromto="0 0 0.05 0 0 0.2" size="0.06" mass="2"/>
      </body>
      <body name="left_leg" pos="0 0.12 0">
        <joint name="left_hip" type="hinge" axis="0 -1 0"/>
        <geom type="capsule" fromto="0 0 -0.08 0 0 -0.4" size="0.03" mass="1" contype="0"
              conaffinity="0"/>
        <geom type="box" pos="0.02 0 -0.48" size="0.12 0.05 0.02" mass="0.5"/>
      </body>
      <body name="right_leg" pos="0 -0.12 0">
        <joint name="right_hip" type="hinge" axis="0 -1 0"/>
        <geom type="capsule" fromto="0 0 -0.08 0 0 -0.4" size="0.03" mass="1" contype="0"
              conaffinity="0"/>
        <geom type="box" pos="0.02 0 -0.48" size="0.12 0.05 0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

_TOML = """
end_effectors = ["torso", "left_leg", "right_leg"]
ground = ["left_leg", "right_leg"]
[gains]
spine = {kp = 60.0, kd = 6.0, torque = 30.0, weight = 1.0}
left_hip = {kp = 80.0, kd = 8.0, torque = 40.0, weight = 0.5}
right_hip = {kp = 80.0, kd = 8.0, torque = 40.0, weight = 0.5}
"""

SPINE = slice(7, 11)  # in qpos
LEFT_HIP, RIGHT_HIP = 11, 12


def write_character(folder: Path) -> Path:
    """Writes `walker.xml` and `walker.toml`; returns the path of the first."""
    path = folder / "walker.xml"
    path.write_text(_XML)
    path.with_suffix(".toml").write_text(_TOML)
    return path


def load_character(folder: Path) -> Character:
    """Returns the walker."""
    return character.load(str(write_character(folder)))


def standing(frames: int = 7) -> np.ndarray:
    """Returns the same upright pose `[frames, nq]` again and again."""
    qpos = np.zeros((frames, 13))
    qpos[:, 2], qpos[:, 3], qpos[:, 7] = 0.5, 1.0, 1.0
    return qpos


def walking(frames: int = 31) -> np.ndarray:
    """Returns a cycle of poses `[frames, nq]`: half a metre ahead while both legs swing."""
    turn = np.linspace(0.0, 2.0 * np.pi, frames)
    qpos = standing(frames)
    qpos[:, 0] = 0.5 * turn / (2.0 * np.pi)
    qpos[:, LEFT_HIP], qpos[:, RIGHT_HIP] = 0.2 * np.sin(turn), -0.2 * np.sin(turn)
    half = 0.05 * np.sin(turn)
    qpos[:, SPINE] = np.stack((np.cos(half), 0 * half, 0 * half, np.sin(half)), 1)
    return qpos


def make_motion(who: Character, qpos: np.ndarray, loop: bool, seconds: float = 1.0) -> Motion:
    """Returns the motion through evenly timed poses."""
    return motion.from_qpos(who.model, qpos, np.linspace(0.0, seconds, len(qpos)), loop)


def write_clip(folder: Path) -> Path:
    """Writes the walk as `walking.npz`; returns its path."""
    qpos = walking()
    hips = [np.stack((np.cos(a / 2), 0 * a, -np.sin(a / 2), 0 * a), 1) for a in qpos[:, 11:].T]
    made = clip_data.build(
        "walking",
        "walking",
        np.linspace(0.0, 1.0, len(qpos)),
        ("spine", "left_hip", "right_hip"),
        qpos[:, :3],
        qpos[:, 3:7],
        np.stack((qpos[:, SPINE], *hips), axis=1),
        loop=True,
    )
    return clip.save(made, folder / "walking.npz")


def make_physics(who: Character, substeps: int = 4) -> tuple[Physics, object]:
    """Returns the cpu physics on one thread and the model loaded for `substeps` a control step."""
    engine = physics_lib.make("cpu", 1, num_envs=1, threads=1)
    return engine, engine.load([character.compile(who, motion.CONTROL_DT / substeps)])


def stopped() -> Physics:
    """Returns an engine in which nothing ever moves.

    It keeps the controls where the accelerations of the last coordinates would be.
    """

    def step(model: object, variant: jax.Array, state: SimState, ctrl: jax.Array) -> SimState:
        return state.replace(qacc=jnp.zeros_like(state.qvel).at[-ctrl.size :].set(ctrl))

    return Physics(
        load=lambda models: None,
        init=lambda model, variant, qpos, qvel: start(qpos, qvel),
        step=step,
    )


def make_env(
    who: Character,
    reference: Motion,
    config: core.EnvConfig = core.EnvConfig(),  # noqa: B008  frozen
    sizes: bounds.BoundsConfig | None = None,
) -> core.Environment:
    """Returns the environment of the walker on the cpu physics."""
    engine, model = make_physics(who, config.substeps)
    made = bounds.make(who, sizes or bounds.BoundsConfig())
    only = variants.one(who, reference, model)
    return core.make(who, only, engine, made, config)


def train_config(folder: Path, **changes) -> TrainConfig:
    """Returns a training of the walker that an update takes milliseconds of."""
    settings = {
        "clip": str(write_clip(folder)),
        "character": str(write_character(folder)),
        "backend": "cpu",
        "envs": 8,
        "horizon": 4,
        "networks": NetworkConfig(policy=(16,), value=(16,)),
        "ppo": PPOConfig(epochs=2, minibatch=16),
    }
    return TrainConfig(**(settings | changes))


def leaves(tree: Any) -> list[np.ndarray]:
    """Returns all arrays, keys as their bits."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in jax.tree.leaves(tree)]


def same_bits(a: Any, b: Any) -> bool:
    """Returns whether all arrays of both are equal."""
    return all(np.array_equal(x, y) for x, y in zip(leaves(a), leaves(b), strict=True))


def assert_same_bits(a: Any, b: Any) -> None:
    """Fails unless all arrays of both are equal."""
    for x, y in zip(leaves(a), leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@contextlib.contextmanager
def compilation_cache(folder: Path) -> Iterator[Path]:
    """Keeps compiled programs in `folder` meanwhile, for tests that compile the same one again."""
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }
    before = {name: getattr(jax.config, name) for name in settings}
    _configure(settings)
    try:
        yield folder
    finally:
        _configure(before)


def _configure(settings: dict) -> None:
    for name, value in settings.items():
        jax.config.update(name, value)
    jax_cache.reset_cache()
