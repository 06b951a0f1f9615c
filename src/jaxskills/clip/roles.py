# SPDX-License-Identifier: Apache-2.0
"""Which part of the body a joint is, told from its name: `LeftUpLeg`, `thigh.L`, `left_hip`.

A role is `trunk`, `neck`, `head`, or `left_`/`right_` with `hip`, `knee`, `ankle`, `toe`,
`clavicle`, `shoulder`, `elbow`, `wrist`. Several joints may share one: spines, hinges of a hip.
"""

import re
from collections.abc import Sequence

import numpy as np

from jaxskills.clip.data import Skeleton

_WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
# Words that say nothing of the body part: exporters' prefixes, hinge axes, counters.
_EMPTY = {"mixamorig", "bip", "character", "joint", "jnt", "x", "y", "z", "roll", "pitch", "yaw"}

_LIMBS = {
    "hip": "hip upleg upperleg thigh femur leghp leghpz leghpx leghpy",
    "knee": "knee leg lowleg lowerleg shin calf tibia legkny",
    "ankle": "ankle foot legaky legakx",
    "toe": "toe toes toebase",
    "clavicle": "clavicle collar",
    "shoulder": "shoulder arm uparm upperarm humerus armshz armshx armely",
    "elbow": "elbow forearm lowerarm lowarm radius armelx",
    "wrist": "wrist hand armwry armwrx",
}
_MIDDLE = {
    "trunk": "spine chest torso back lowerback upperback thorax abdomen waist"
    " backbkz backbky backbkx",
    "neck": "neck neckry",
    "head": "head",
}
_LIMB_OF = {stem: role for role, stems in _LIMBS.items() for stem in stems.split()}
_MIDDLE_OF = {stem: role for role, stems in _MIDDLE.items() for stem in stems.split()}


def groups(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Returns role -> the joints that have it, in the order of `names`. Others are left out."""
    found: dict[str, list[str]] = {}
    for name in names:
        role = _role(name)
        if role:
            found.setdefault(role, []).append(name)
    for side in ("left", "right"):
        arm = found.get(f"{side}_shoulder", [])
        called_shoulder = [name for name in arm if "shoulder" in name.lower()]
        if called_shoulder and len(called_shoulder) < len(arm):  # Mixamo: Shoulder, then Arm
            found.setdefault(f"{side}_clavicle", []).extend(called_shoulder)
            found[f"{side}_shoulder"] = [name for name in arm if name not in called_shoulder]
    return {role: tuple(joints) for role, joints in found.items()}


def of(names: Sequence[str]) -> dict[str, str]:
    """Returns role -> the joint that turns this part of the body, the last of its group."""
    return {role: joints[-1] for role, joints in groups(names).items()}


def leg_length(names: Sequence[str], skeleton: Skeleton) -> float | None:
    """Returns hip to ankle along the bones, in the skeleton's unit; None if not named."""
    found = of(names)
    lengths = []
    for side in ("left", "right"):
        if f"{side}_hip" in found and f"{side}_ankle" in found:
            joint, top = names.index(found[f"{side}_ankle"]), names.index(found[f"{side}_hip"])
            length = 0.0
            while joint not in (top, -1):
                length += float(np.linalg.norm(skeleton.offsets[joint]))
                joint = skeleton.parents[joint]
            lengths.append(length)
    return float(np.mean(lengths)) if lengths and np.mean(lengths) > 0 else None


def _role(name: str) -> str | None:
    words = [word.lower() for word in _WORD.findall(name.rsplit(":", 1)[-1])]
    if "twist" in words:
        return None
    side = next((_SIDES[word] for word in words if word in _SIDES), None)
    rest = [w for w in words if w not in _SIDES and w not in _EMPTY and not w.isdigit()]
    stem = "".join(rest)
    for prefix, meant in (("left", "left"), ("right", "right"), ("l", "left"), ("r", "right")):
        if side is None and stem.startswith(prefix) and stem[len(prefix) :] in _LIMB_OF:
            side, stem = meant, stem[len(prefix) :]
    if side:
        return f"{side}_{_LIMB_OF[stem]}" if stem in _LIMB_OF else None
    return _MIDDLE_OF.get(stem)
