# SPDX-License-Identifier: Apache-2.0
"""Things that stand in the way: boxes to jump over, onto or off, walls, bars (FS section 7.1).

Each is a condition, so a task parameter can change it, or part of the `scenery` of a task:

    TaskSpec(
        (Parameter("height", (0.9, 3.0), condition=obstacles.box((0.5, 0.0), (0.1, 1.2), 0.15)),),
        scenery=(obstacles.bar((0.56, 0.0), 2.3),),
    )

Whatever its height, a box is in every variant, so that all models have the same sizes: one of no
height lies under the floor.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np

from jaxskills.character import Character
from jaxskills.env import holds
from jaxskills.env.holds import Grip
from jaxskills.env.task import Condition
from jaxskills.errors import UserError, unknown

_BELOW = 1.0  # m that a box reaches into the floor, and that one of no height lies under it
_LARGEST = 100.0  # m
_WOOD, _STEEL = (0.72, 0.55, 0.36, 1.0), (0.42, 0.44, 0.47, 1.0)


def box(
    center: tuple[float, float],
    size: tuple[float, float],
    height: float,
    name: str = "box",
    yaw: float = 0.0,
) -> Condition:
    """Returns the condition that a box stands on the floor; the factor multiplies its height.

    Args:
      center: m, where it stands.
      size: m, its sides along x and y.
      height: m, of its top above the floor. 0: out of the way, until `step` says otherwise.
      name: of the box.
      yaw: rad, how far it is turned about the vertical.

    Raises:
      UserError: a number out of range.
    """
    _check(f"box {name}: center", center, -_LARGEST)
    _check(f"box {name}: size", size, 1e-3)
    _check(f"box {name}: height", (height,), 0.0)
    _check(f"box {name}: yaw", (yaw,), -_LARGEST)

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        floor = spec.geom("floor")
        geom = _add(spec, name, mujoco.mjtGeom.mjGEOM_BOX, _WOOD)
        geom.pos, geom.size = [*center, 0.0], [size[0] / 2, size[1] / 2, 1.0]
        geom.quat = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
        for field in ("contype", "conaffinity", "condim", "friction", "solref", "solimp"):
            setattr(geom, field, getattr(floor, field))
        for pair in list(spec.pairs):
            if "floor" in _names(pair):
                (other,) = {*_names(pair)} - {"floor"}
                _pair(spec, name, other, pair)
        _set_top(geom, factor * height)

    return change


def bar(
    center: tuple[float, float],
    height: float,
    name: str = "bar",
    length: float = 1.2,
    radius: float = 0.015,
    grip: Grip | None = None,
) -> Condition:
    """Returns the condition that a bar lies across x; the factor multiplies its height.

    It is solid for all of the character that can touch the ground, but for hands that hold it,
    which close around it.

    Args:
      center: m, x and y of its middle.
      height: m, of its axis above the floor.
      name: of the bar.
      length: m.
      radius: m.
      grip: who holds it, and when; None: nobody.

    Raises:
      UserError: a number out of range.
    """
    _check(f"bar {name}: center", center, -_LARGEST)
    _check(f"bar {name}: height, length, radius", (height, length, radius), 1e-3)

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        geom = _add(spec, name, mujoco.mjtGeom.mjGEOM_CAPSULE, _STEEL)
        middle, half = np.array([*center, factor * height]), np.array([0.0, length / 2, 0.0])
        geom.fromto, geom.size = [*(middle - half), *(middle + half)], [radius, 0.0, 0.0]
        geom.contype = geom.conaffinity = 0
        hands = () if grip is None else grip.hands
        for other in _solid(spec, character, hands):
            _pair(spec, name, other)
        if grip is not None:
            holds.add(spec, character, grip, name, middle, length)

    return change


def moved(name: str, by: tuple[float, float]) -> Condition:
    """Returns the condition that an object is (factor - 1) times `by` (m) from its place.

    Raises:
      UserError: a number out of range, or, when it is applied, no object of that name.
    """
    _check(f"object {name}: by", by, -_LARGEST)

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        geom = _object(spec, name)
        geom.pos = np.asarray(geom.pos) + (factor - 1.0) * np.array([*by, 0.0])

    return change


def step(first: str, second: str) -> Condition:
    """Returns the condition that the second of two boxes is that much higher (m) than the first.

    The lower of them is the floor itself: from 0 upwards the first, below 0 the second.
    """

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        _set_top(_object(spec, first), -factor)
        _set_top(_object(spec, second), factor)

    return change


def _add(
    spec: mujoco.MjSpec, name: str, kind: mujoco.mjtGeom, color: Sequence[float]
) -> mujoco.MjsGeom:
    if name in [geom.name for geom in spec.geoms]:
        raise UserError(f"object {name}: there is another geom of that name, give it its own")
    return spec.worldbody.add_geom(name=name, type=kind, rgba=color, group=0)


def _object(spec: mujoco.MjSpec, name: str) -> mujoco.MjsGeom:
    names = [geom.name for geom in spec.worldbody.geoms if geom.name != "floor"]
    if name not in names:
        raise unknown("object", name, names or ["none, as the task has no scenery"])
    return spec.geom(name)


def _set_top(geom: mujoco.MjsGeom, height: float) -> None:
    """Makes a box reach from below the floor up to a height; without any it lies underneath."""
    low, high = (-_BELOW, height) if height > 0.0 else (-2.0 * _BELOW, -_BELOW)
    pos, size = np.array(geom.pos), np.array(geom.size)
    pos[2], size[2] = (low + high) / 2, (high - low) / 2
    geom.pos, geom.size = pos, size


def _solid(spec: mujoco.MjSpec, character: Character, spared: Sequence[str]) -> list[str]:
    """Returns the names of the geoms that can touch the floor, but for those of `spared` bodies.

    A geom that has no name gets one: pairs need it.
    """
    for body in spared:
        character.body(body)
    floor = spec.geom("floor")
    pairs = {n for p in spec.pairs if "floor" in _names(p) for n in _names(p)}
    found = []
    for body in character.body_names:
        for number, geom in enumerate(spec.body(body).geoms):
            dynamic = geom.contype & floor.conaffinity or floor.contype & geom.conaffinity
            if body in spared or not (dynamic or geom.name in pairs):
                continue
            geom.name = geom.name or f"{body}_{number}"
            found.append(geom.name)
    return found


def _names(pair: mujoco.MjsPair) -> tuple[str, str]:
    return pair.geomname1, pair.geomname2


def _pair(spec: mujoco.MjSpec, name: str, other: str, like: mujoco.MjsPair | None = None) -> None:
    pair = spec.add_pair(geomname1=name, geomname2=other)
    if like is not None:
        for field in ("condim", "friction", "solref", "solreffriction", "solimp", "margin", "gap"):
            setattr(pair, field, getattr(like, field))


def _check(what: str, values: Sequence[float], least: float) -> None:
    if not all(math.isfinite(value) and least <= value <= _LARGEST for value in values):
        shown = ", ".join(f"{value:g}" for value in values)
        raise UserError(f"{what} is {shown}: give {least:g} to {_LARGEST:g}")
