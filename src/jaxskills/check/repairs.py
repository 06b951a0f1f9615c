# SPDX-License-Identifier: Apache-2.0
"""Repairs of faults that clip files come with. Each returns a new clip."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills.clip import roles
from jaxskills.clip.data import Clip
from jaxskills.errors import unknown

# What x (forward), y (left) and z (up) ought to be, in the axes as read.
AXES = {
    "y is up in the file, but was read as z up": "x -z y",
    "y is up and z forward in the file, but was read as z up and x forward": "z x y",
    "z is up in the file, but was read as y up": "x z -y",
    "z is up and x forward in the file, but was read as y up and z forward": "y z x",
}

TURNED = ("everything", "world", "positions")

UNITS = {
    "centimetres, but was read as metres": 0.01,
    "millimetres, but was read as metres": 0.001,
    "inches, but was read as metres": 0.0254,
    "feet, but was read as metres": 0.3048,
    "metres, but was read as centimetres": 100.0,
    "metres, but was read as millimetres": 1000.0,
    "millimetres, but was read as centimetres": 0.1,
    "metres, but was read as inches": 1.0 / 0.0254,
}

_LIMBS = {
    "arms": ("clavicle", "shoulder", "elbow", "wrist"),
    "legs": ("hip", "knee", "ankle", "toe"),
}


def rescale(clip: Clip, factor: float) -> Clip:
    """Returns the clip with its root positions multiplied by `factor`."""
    return dataclasses.replace(clip, root_pos=factor * clip.root_pos)


def turn_axes(clip: Clip, axes: str, what: str = "everything") -> Clip:
    """Returns the clip written in other axes.

    Args:
      clip: what to turn.
      axes: what x, y and z ought to be in the axes as read, such as 'x -z y'.
      what: 'everything' (also the joints' own frames), 'world' (root position and orientation in
        the world), or 'positions' (of the root).
    """
    if what not in TURNED:
        raise unknown("what to turn", what, TURNED)
    rows = [np.eye(3)["xyz".index(a[-1])] * (-1.0 if a[0] == "-" else 1.0) for a in axes.split()]
    turn = Rotation.from_matrix(np.array(rows))
    changed = {"root_pos": turn.apply(clip.root_pos)}
    if what != "positions":
        inner = turn.inv() if what == "everything" else Rotation.identity()
        read = Rotation.from_quat(clip.root_rot, scalar_first=True)
        changed["root_rot"] = (turn * read * inner).as_quat(scalar_first=True)
    if what == "everything":
        read = Rotation.from_quat(clip.rotations.reshape(-1, 4), scalar_first=True)
        turned = (turn * read * turn.inv()).as_quat(scalar_first=True)
        changed["rotations"] = turned.reshape(clip.rotations.shape)
    return dataclasses.replace(clip, **changed)


def swap_sides(clip: Clip, parts: str = "arms and legs") -> Clip:
    """Returns the clip with the rotations of left and right limbs exchanged.

    Args:
      clip: what to change.
      parts: 'arms and legs', 'arms' or 'legs'.
    """
    if parts not in ("arms and legs", *_LIMBS):
        raise unknown("parts", parts, ("arms and legs", *_LIMBS))
    named = roles.of(clip.joints)
    order = list(range(len(clip.joints)))
    for limb in (limb for part in parts.split(" and ") for limb in _LIMBS[part]):
        left, right = named.get(f"left_{limb}"), named.get(f"right_{limb}")
        if left and right:
            i, j = clip.joints.index(left), clip.joints.index(right)
            order[i], order[j] = j, i
    return dataclasses.replace(clip, rotations=clip.rotations[:, order])


def rename_sides(clip: Clip) -> Clip:
    """Returns the clip with the names of left and right joints exchanged, motion untouched."""
    named = roles.of(clip.joints)
    other = {}
    for role, joint in named.items():
        side, _, limb = role.partition("_")
        mirrored = named.get({"left": "right_", "right": "left_"}.get(side, "") + limb)
        if limb and mirrored:
            other[joint] = mirrored
    return dataclasses.replace(clip, joints=tuple(other.get(name, name) for name in clip.joints))


def flip(clip: Clip, joint: str) -> Clip:
    """Returns the clip with one joint turning the other way."""
    if joint not in clip.joints:
        raise unknown(f"joint of clip '{clip.name}'", joint, clip.joints)
    rotations = clip.rotations.copy()
    rotations[:, clip.joints.index(joint), 1:] *= -1.0
    return dataclasses.replace(clip, rotations=rotations)
