# SPDX-License-Identifier: Apache-2.0
"""Numbers that tell a sound motion from a misread one, once it is posed on a character."""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills import retarget
from jaxskills.character import Character
from jaxskills.clip import roles
from jaxskills.clip.data import Clip
from jaxskills.retarget import mapping as mappings
from jaxskills.retarget import posed
from jaxskills.retarget.mapping import Mapping

_FRAMES = 60  # at most so many frames are looked at when whole hypotheses are compared
_SLACK = 0.05  # rad, overshoot of a joint's range that nobody sees


@dataclasses.dataclass(frozen=True, eq=False)
class Limit:
    """One joint axis with a range, along the clip."""

    joint: str
    axis: str  # '' for a hinge, else x, y or z of the rotation vector
    low: float
    high: float
    values: np.ndarray  # [F] rad

    def excess(self, values: np.ndarray | None = None) -> np.ndarray:
        """Returns how far [F] the values are outside the range, in rad, 0 inside."""
        values = self.values if values is None else values
        out = np.maximum(self.low - values, values - self.high)
        return np.where(out > _SLACK, out, 0.0)


@dataclasses.dataclass(frozen=True)
class World:
    """How a clip stands in the world: what wrong units or axes would upset."""

    floor: float  # m, mean distance of the lowest point from the floor
    height: float  # median root height over that of the character standing
    upright: float  # mean of the root's up axis along z


def standing_height(character: Character) -> float:
    """Returns the root's height in m with straight legs and soles on the floor."""
    model = character.model
    lowest = posed.look(model, model.qpos0[None]).lowest[0]
    return float(model.qpos0[2] - lowest)


def world(character: Character, clip: Clip, mapping: Mapping) -> World:
    """Returns how the clip stands in the world, without any automatic lift."""
    mapping = dataclasses.replace(mapping, lift=mapping.lift or 0.0)
    qpos = retarget.retarget(character, thinned(clip, _FRAMES // 4), mapping)
    view = posed.look(character.model, qpos)
    return World(
        floor=float(np.abs(view.lowest).mean()),
        height=float(np.median(qpos[:, 2]) / standing_height(character)),
        upright=float(view.turns[:, 1, 2, 2].mean()),
    )


def limits(character: Character, qpos: np.ndarray) -> list[Limit]:
    """Returns every limited joint axis: hinge ranges of the model, ball ranges of the toml."""
    model, found = character.model, []
    for index in range(model.njnt):
        name, address = model.joint(index).name, model.jnt_qposadr[index]
        if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_HINGE and model.jnt_limited[index]:
            low, high = model.jnt_range[index]
            found.append(Limit(name, "", float(low), float(high), qpos[:, address]))
        if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_BALL:
            turn = Rotation.from_quat(qpos[:, address : address + 4], scalar_first=True)
            vector = turn.as_rotvec()
            for axis, (low, high) in character.limits.get(name, {}).items():
                values = vector[:, "xyz".index(axis)]
                found.append(Limit(name, axis, float(low), float(high), values))
    return found


def sidedness(character: Character, clip: Clip, mapping: Mapping) -> float:
    """Returns how unlikely the limbs are, the sum of four signs that left and right are exchanged.

    Limbs run into each other or the trunk; ball joints leave their ranges, which differ between
    the sides; feet stand crossed; thighs and toes turn inwards. The terms are scaled to be about 1
    for a walk with its sides exchanged. Only differences between two readings of one clip count.
    """
    model = character.model
    qpos = retarget.retarget(character, thinned(clip, _FRAMES), mapping)
    view = posed.look(model, qpos, overlap=True)
    over = sum(limit.excess().mean() for limit in limits(character, qpos) if limit.axis)
    total = float(view.overlap.mean()) / 0.05 + float(over) / 0.5
    joints = {joint.name: model.jnt_bodyid[i] for i, joint in enumerate(character.layout.joints)}
    part = {role: joints[name] for role, name in roles.of(tuple(joints)).items()}
    if not {"left_hip", "right_hip", "left_ankle", "right_ankle"} <= set(part):
        return total
    root = view.turns[:, 1]
    forward = mappings.facing(character).inv().apply([1.0, 0.0, 0.0])
    left = mappings.facing(character).inv().apply([0.0, 1.0, 0.0])

    def outward(side: str, limb: str) -> np.ndarray:
        points = view.turns[:, part[f"{side}_{limb}"]] @ forward
        return np.einsum("fi,fij,j->f", points, root, left)

    apart = view.positions[:, part["left_ankle"]] - view.positions[:, part["right_ankle"]]
    crossed = np.maximum(-np.einsum("fi,fij,j->f", apart, root, left), 0.0)
    turned = [outward("left", limb) - outward("right", limb) for limb in ("hip", "ankle")]
    return total + float(crossed.mean()) / 0.1 - float(np.mean(turned)) / 0.3


def thinned(clip: Clip, frames: int) -> Clip:
    """Returns the clip with at most about `frames` of its frames."""
    keep = np.unique(np.linspace(0, len(clip.times) - 1, frames).astype(int))
    return dataclasses.replace(
        clip,
        times=clip.times[keep],
        root_pos=clip.root_pos[keep],
        root_rot=clip.root_rot[keep],
        rotations=clip.rotations[keep],
    )
