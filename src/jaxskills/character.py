# SPDX-License-Identifier: Apache-2.0
"""Characters: an MJCF file and its servo settings, made ready for the engine.

`NAME.xml` is the body, `NAME.toml` beside it holds what MJCF has no word for: servo gains by joint
name, end effectors, the bodies that may touch the ground. A user's MJCF needs no toml: then gains
follow from the mass and leaf bodies are the end effectors.
"""

import dataclasses
import fnmatch
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from jaxskills import pose
from jaxskills.errors import UserError, unknown
from jaxskills.paths import data_dir

# FS and SB simulate finer; this is the coarsest step whose skills also stand at 600 Hz.
DEFAULT_TIMESTEP = 1.0 / 120.0

INTEGRATORS = {
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}

# Gains of a joint that no file names, per kg of the whole character: kp in Nm/rad, kd = kp/10.
_KP_PER_KG = 10.0

_TOML_KEYS = ("forward", "end_effectors", "ground", "gains", "limits")


@dataclasses.dataclass(frozen=True)
class Gains:
    """Servo of one joint, the same on each of its axes."""

    kp: float  # N m / rad
    kd: float  # N m s / rad
    torque: float  # N m, largest
    weight: float = 1.0  # of this joint in the imitation reward


class Object(NamedTuple):
    """A thing that moves beside a character: a body of the same model, see `objects.py`."""

    name: str  # of its body
    # (spec) -> adds that body with k slide joints to the world, what it touches, X actuators
    build: Callable[[mujoco.MjSpec], None]
    # (character, motion) -> [F, k] its joints along the reference. None: it is parked, all are 0
    path: Callable[..., np.ndarray] | None = None
    # (character, length) -> (sim, body, phase, dphase) -> sim, controls [X]; see `objects.Scene`
    act: Callable[..., Callable[..., Any]] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Character:
    """A character on the host. N bodies (the world left out), nu actuated degrees of freedom."""

    name: str
    source: str  # path of the MJCF
    model: mujoco.MjModel  # compiled with servos at the default time step
    layout: pose.Layout
    body_names: tuple[str, ...]  # [N]; body i is MuJoCo body i + 1
    gains: dict[str, Gains]  # by joint name
    actuated: np.ndarray  # [nu] displacement index of each servo
    kp: np.ndarray  # [nu] N m / rad
    kd: np.ndarray  # [nu] N m s / rad
    torque: np.ndarray  # [nu] N m
    end_effectors: tuple[str, ...]
    ground: tuple[str, ...]  # bodies that may touch the ground without it being a fall
    forward: np.ndarray  # [3] facing at the zero pose
    limits: dict[str, dict[str, tuple[float, float]]]  # rad, information for clip checks
    scenery: tuple[
        Callable[[mujoco.MjSpec], None], ...
    ] = ()  # puts things around it, when compiled
    objects: tuple[Object, ...] = ()  # in the order of their joints, after the character's own

    @property
    def mass(self) -> float:
        """Total mass in kg, the floor and objects left out."""
        return float(self.model.body_mass[1 : pose.own_bodies(self.model) + 1].sum())

    @property
    def weights(self) -> dict[str, float]:
        """Joint name to its weight in the imitation reward."""
        return {name: gains.weight for name, gains in self.gains.items()}

    def body(self, name: str) -> int:
        """Returns the index of a body among `body_names`.

        Raises:
          UserError: no such body; the message lists the names.
        """
        if name not in self.body_names:
            raise unknown(f"body of {self.name}", name, self.body_names)
        return self.body_names.index(name)

    def bodies(self, patterns: Iterable[str]) -> frozenset[int]:
        """Returns the indices of the bodies whose name is one of `patterns`, as in `*_knee`.

        Raises:
          UserError: a pattern that no body matches; the message lists the names.
        """
        found: set[int] = set()
        for pattern in patterns:
            names = fnmatch.filter(self.body_names, pattern)
            found |= {self.body(name) for name in names or (pattern,)}
        return frozenset(found)


def available() -> tuple[str, ...]:
    """Returns the names of the shipped characters."""
    return tuple(sorted(path.stem for path in (data_dir() / "characters").glob("*.xml")))


def find(name: str) -> Path:
    """Returns the MJCF file of a shipped character or of a path.

    Raises:
      UserError: neither a shipped name nor a file.
    """
    shipped = data_dir() / "characters" / f"{name}.xml"
    if shipped.is_file():
        return shipped
    if Path(name).suffix == ".xml" and Path(name).is_file():
        return Path(name)
    raise unknown("character", name, (*available(), "FILE.xml"))


def load(name: str) -> Character:
    """Returns the character of a shipped name (`humanoid34`) or of an MJCF file.

    Raises:
      UserError: unknown name, broken MJCF or toml, a joint name that is not in the MJCF.
    """
    path = find(name)
    bare = _bare_spec(path)
    try:
        model = bare.compile()
    except ValueError as error:
        raise UserError(f"character '{path}' does not compile: {_one_line(error)}") from None
    layout = pose.Layout.of(model)
    if not layout.joints or layout.joints[0].kind != "free":
        raise UserError(f"character '{path}': its first joint must be free (a floating root)")
    settings = _settings(path.with_suffix(".toml"), model, layout)
    gains = settings["gains"]
    movable = [joint for joint in layout.own.joints if joint.name in gains]
    joints = [joint for joint in movable if gains[joint.name].kp > 0]
    per_dof = [(dof, gains[joint.name]) for joint in joints for dof in joint.dofs]
    body_names = tuple(model.body(i + 1).name for i in range(pose.own_bodies(model)))
    character = Character(
        name=path.stem,
        source=str(path),
        model=model,
        layout=layout,
        body_names=body_names,
        gains=gains,
        actuated=np.array([dof for dof, _ in per_dof], np.int32),
        kp=np.array([g.kp for _, g in per_dof]),
        kd=np.array([g.kd for _, g in per_dof]),
        torque=np.array([g.torque for _, g in per_dof]),
        end_effectors=tuple(settings["end_effectors"]),
        ground=tuple(settings["ground"]),
        forward=np.array(settings["forward"], float),
        limits=settings["limits"],
    )
    for body in (*character.end_effectors, *character.ground):
        character.body(body)
    return dataclasses.replace(character, model=compile(character, DEFAULT_TIMESTEP))


def placed(
    character: Character,
    scenery: Sequence[Callable[[mujoco.MjSpec], None]],
    timestep: float = DEFAULT_TIMESTEP,
) -> Character:
    """Returns the character among more things, which `scenery` puts into the spec one by one.

    Whatever is made of it simulates, measures and films it there. Its model has this time step (s).
    """
    among = dataclasses.replace(character, scenery=(*character.scenery, *scenery))
    return dataclasses.replace(among, model=compile(among, timestep))


def compile(  # noqa: A001
    character: Character,
    timestep: float,
    integrator: str = "discrete",
) -> mujoco.MjModel:
    """Returns the model with one position servo per actuated degree of freedom.

    The actuators of objects come first, then those of its scenery, then the servos.

    `discrete` is implicit in positions and velocities and solves contacts with the same implicit
    mass. `implicitfast`, for engines without it, gets kv = kd + h kp, which has the right hand side
    of stable PD (Tan et al. 2011), but solves contacts as if there were no servos: at 120 Hz feet
    slip at 0.4 m/s and learning stalls. Torques are limited by the set point (see `physics.servo`),
    since a clamped actuator loses its implicit damping and makes light links blow up.

    Args:
      character: what to compile.
      timestep: h in s.
      integrator: one of `INTEGRATORS`.

    Raises:
      UserError: unknown integrator.
    """
    if integrator not in INTEGRATORS:
        raise unknown("integrator", integrator, INTEGRATORS)
    spec = _bare_spec(Path(character.source))
    for thing in character.objects:
        thing.build(spec)
    for change in character.scenery:
        change(spec)
    spec.option.timestep = timestep
    spec.option.integrator = INTEGRATORS[integrator]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    fold = timestep if integrator == "implicitfast" else 0.0
    servos = zip(character.kp, character.kd, strict=True)
    names = [joint.name for joint in character.layout.joints for _ in joint.dofs]
    axes = [axis for joint in character.layout.joints for axis in range(len(joint.dofs))]
    for dof, (kp, kd) in zip(character.actuated, servos, strict=True):
        gear = np.zeros(6)
        gear[axes[dof]] = 1.0
        servo = spec.add_actuator(name=f"{names[dof]}_{axes[dof]}", target=names[dof], gear=gear)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=kp, kv=kd + fold * kp)
    return spec.compile()


def _bare_spec(path: Path) -> mujoco.MjSpec:
    """Returns the spec without actuators, sensors and keyframes, with a floor named `floor`."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise UserError(f"character '{path}' cannot be read: {_one_line(error)}") from None
    for extra in (*spec.actuators, *spec.sensors, *spec.keys):
        spec.delete(extra)
    planes = [g for g in spec.worldbody.geoms if g.type == mujoco.mjtGeom.mjGEOM_PLANE]
    if planes:
        planes[0].name = "floor"
    else:
        spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])
    return spec


def _settings(path: Path, model: mujoco.MjModel, layout: pose.Layout) -> dict:
    """Returns the toml's content with everything it leaves out filled in."""
    raw = {}
    if path.is_file():
        try:
            raw = tomllib.loads(path.read_text())
        except tomllib.TOMLDecodeError as error:
            raise UserError(f"'{path}' is not valid TOML: {error}") from None
    for key in raw:
        if key not in _TOML_KEYS:
            raise unknown(f"entry in '{path}'", key, _TOML_KEYS)
    movable = {joint.name: joint for joint in layout.own.joints if joint.kind != "free"}
    for table in ("gains", "limits"):
        for name in raw.get(table, {}):
            if name not in movable:
                raise unknown(f"joint in [{table}] of '{path}'", name, movable)
    bodies = range(1, pose.own_bodies(model) + 1)
    kp = _KP_PER_KG * float(model.body_mass[: bodies.stop].sum())
    default = Gains(kp, kp / 10.0, kp)
    leaves = [i for i in bodies if not (model.body_parentid[1:] == i).any()]
    lowest = _lowest_bodies(model, leaves)
    names = [model.body(i).name for i in range(model.nbody)]
    return {
        "forward": raw.get("forward", [1.0, 0.0, 0.0]),
        "end_effectors": raw.get("end_effectors", [names[i] for i in leaves]),
        "ground": raw.get("ground", [names[i] for i in lowest]),
        "gains": {
            name: _gains(path, name, raw["gains"][name])
            if name in raw.get("gains", {})
            else default
            for name in movable
        },
        "limits": raw.get("limits", {}),
    }


def _gains(path: Path, joint: str, table: dict) -> Gains:
    fields = {field.name for field in dataclasses.fields(Gains)}
    for key, value in table.items():
        if key not in fields:
            raise unknown(f"entry in [gains.{joint}] of '{path}'", key, sorted(fields))
        if not isinstance(value, int | float) or not value >= 0:
            raise UserError(f"'{path}': {key} of joint {joint} is {value}: give a number >= 0")
    missing = {"kp", "kd", "torque"} - set(table)
    if missing:
        raise UserError(f"'{path}': [gains.{joint}] lacks {', '.join(sorted(missing))}")
    return Gains(**{key: float(value) for key, value in table.items()})


def _lowest_bodies(model: mujoco.MjModel, leaves: list[int]) -> list[int]:
    """Returns the leaves within 10 cm of the lowest one at the zero pose: the feet."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    height = {i: data.xpos[i, 2] for i in leaves}
    return [i for i in leaves if height[i] < min(height.values()) + 0.1]


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
