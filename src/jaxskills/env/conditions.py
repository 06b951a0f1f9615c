# SPDX-License-Identifier: Apache-2.0
"""Conditions of a family of skills: what is changed in the model before it is compiled.

Each takes the spec, its character and a factor, 1 for no change. A user writes one in a few lines
of MuJoCo's own `MjSpec`.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from jaxskills.character import Character
from jaxskills.env.task import Condition
from jaxskills.errors import unknown


def gravity(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
    """Multiplies gravity."""
    spec.option.gravity = np.asarray(spec.option.gravity) * factor


def mass(bodies: Sequence[str]) -> Condition:
    """Returns the condition that multiplies the masses of these bodies."""

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        for body in _bodies(spec, character, bodies):
            for geom in body.geoms:
                _weigh(geom, factor)

    return change


def length(bodies: Sequence[str]) -> Condition:
    """Returns the condition that makes these bodies longer, their masses with them.

    Shapes keep their thickness. What is attached to them moves outwards; what is not among the
    bodies keeps its size.
    """

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        for body in _bodies(spec, character, bodies):
            for geom in body.geoms:
                geom.pos = np.asarray(geom.pos) * factor
                geom.fromto = np.asarray(geom.fromto) * factor
                axial = _axial(geom)
                if axial is not None:
                    size = np.array(geom.size)
                    size[axial] *= factor
                    geom.size = size
                _weigh(geom, factor)
            for child in body.bodies:
                child.pos = np.asarray(child.pos) * factor

    return change


def width(bodies: Sequence[str]) -> Condition:
    """Returns the condition that makes these bodies thicker, their masses with the square of it."""

    def change(spec: mujoco.MjSpec, character: Character, factor: float) -> None:
        for body in _bodies(spec, character, bodies):
            for geom in body.geoms:
                size, axial = np.array(geom.size), _axial(geom)
                for i in range(len(size)):
                    size[i] *= 1.0 if i == axial else factor
                geom.size = size
                _weigh(geom, factor**2)

    return change


def _bodies(
    spec: mujoco.MjSpec, character: Character, names: Sequence[str]
) -> list[mujoco.MjsBody]:
    for name in names:
        if name not in character.body_names:
            raise unknown(f"body of {character.name}", name, character.body_names)
    return [spec.body(name) for name in names]


def _axial(geom: mujoco.MjsGeom) -> int | None:
    """Returns which size of a geom lies along its local z, if it has one.

    A capsule or cylinder given by its two ends has its length there.
    """
    kinds = mujoco.mjtGeom
    if geom.type in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
        return 1
    return 2 if geom.type in (kinds.mjGEOM_BOX, kinds.mjGEOM_ELLIPSOID) else None


def _weigh(geom: mujoco.MjsGeom, factor: float) -> None:
    """Multiplies a mass that was given. One that follows from a density grows with the sizes."""
    if np.isfinite(geom.mass):
        geom.mass *= factor
