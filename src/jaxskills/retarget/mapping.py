# SPDX-License-Identifier: Apache-2.0
"""Which clip joint drives which character joint: ready-made tables, and a guess from names."""

import dataclasses
from collections.abc import Mapping as Table

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills.character import Character
from jaxskills.clip import deepmimic, roles
from jaxskills.clip.data import Clip, Skeleton

# Zero poses that point a bone this much apart get a rest rotation; less is a matter of style.
_REST_DEGREES = 15.0


@dataclasses.dataclass(frozen=True)
class Mapping:
    """How a clip is put onto a character.

    `rest` is the pose of the character that looks like the clip's zero pose: at a clip joint, how
    far its limb must be turned from the character's own zero pose. Everything below turns along.
    """

    joints: Table[str, str | tuple[str, ...]]  # clip joint -> character joint(s), in chain order
    rest: Table[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    # ^ clip joint -> degrees about the fixed x, then y, then z axis
    scale: float | None = None  # of root positions; None: ratio of the leg lengths, if known
    lift: float | None = 0.0  # m added to the root's height; None: what puts the feet on the floor
    ignored: tuple[str, ...] = ()  # clip joints left out on purpose


_ARMS_HANG = {"left_shoulder": (-90.0, 0.0, 0.0), "right_shoulder": (90.0, 0.0, 0.0)}
_ARMS_OUT = {"LeftArm": (90.0, 0.0, 0.0), "RightArm": (-90.0, 0.0, 0.0)}

DEEPMIMIC_TO_HUMANOID34 = Mapping({name: name for name in deepmimic.JOINTS})

DEEPMIMIC_TO_ATLAS = Mapping(
    {
        "chest": ("back_bkz", "back_bky", "back_bkx"),
        "neck": "neck_ry",
        "left_shoulder": ("l_arm_shz", "l_arm_shx", "l_arm_ely"),
        "left_elbow": "l_arm_elx",
        "right_shoulder": ("r_arm_shz", "r_arm_shx", "r_arm_ely"),
        "right_elbow": "r_arm_elx",
        "left_hip": ("l_leg_hpz", "l_leg_hpx", "l_leg_hpy"),
        "left_knee": "l_leg_kny",
        "left_ankle": ("l_leg_aky", "l_leg_akx"),
        "right_hip": ("r_leg_hpz", "r_leg_hpx", "r_leg_hpy"),
        "right_knee": "r_leg_kny",
        "right_ankle": ("r_leg_aky", "r_leg_akx"),
    },
    # Atlas's arms point sideways at its zero pose and its elbows bend about another axis.
    rest={"left_shoulder": (-90.0, 0.0, 90.0), "right_shoulder": (90.0, 0.0, -90.0)},
    scale=1.0,
    lift=0.10,
)

DEEPMIMIC_TO_HUMAN21 = Mapping(
    {
        "chest": ("Spine", "Spine1", "Spine2"),
        "neck": "Neck",
        "left_shoulder": "LeftArm",
        "left_elbow": "LeftForeArm",
        "right_shoulder": "RightArm",
        "right_elbow": "RightForeArm",
        "left_hip": "LeftUpLeg",
        "left_knee": "LeftLeg",
        "left_ankle": "LeftFoot",
        "right_hip": "RightUpLeg",
        "right_knee": "RightLeg",
        "right_ankle": "RightFoot",
    },
    rest=_ARMS_HANG,
    lift=None,
)

MIXAMO_TO_HUMANOID34 = Mapping(
    {
        "Spine2": "chest",
        "Head": "neck",
        "LeftArm": "left_shoulder",
        "LeftForeArm": "left_elbow",
        "RightArm": "right_shoulder",
        "RightForeArm": "right_elbow",
        "LeftUpLeg": "left_hip",
        "LeftLeg": "left_knee",
        "LeftFoot": "left_ankle",
        "RightUpLeg": "right_hip",
        "RightLeg": "right_knee",
        "RightFoot": "right_ankle",
    },
    rest=_ARMS_OUT,
    lift=None,
    ignored=("Spine", "Spine1", "Neck", "LeftShoulder", "RightShoulder", "LeftHand", "RightHand")
    + ("LeftToeBase", "RightToeBase"),
)

_HUMAN21 = (
    *("Spine", "Spine1", "Spine2", "Neck", "Head"),
    *("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
    *("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    *("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
)
MIXAMO_TO_HUMAN21 = Mapping({name: name for name in _HUMAN21})

# A table serves where all its clip joints and all its character joints exist.
PRESETS = {
    "deepmimic_humanoid34": DEEPMIMIC_TO_HUMANOID34,
    "deepmimic_atlas": DEEPMIMIC_TO_ATLAS,
    "deepmimic_human21": DEEPMIMIC_TO_HUMAN21,
    "mixamo_human21": MIXAMO_TO_HUMAN21,
    "mixamo_humanoid34": MIXAMO_TO_HUMANOID34,
}


def targets(mapping: Mapping) -> dict[str, tuple[str, ...]]:
    """Returns clip joint -> tuple of character joints."""
    return {
        source: (to,) if isinstance(to, str) else tuple(to) for source, to in mapping.joints.items()
    }


def guess_mapping(character: Character, clip: Clip) -> Mapping:
    """Returns a preset that fits, else a mapping by body part with rest rotations from the bones.

    Joints are matched by what their names say (`roles`); limbs whose zero poses point elsewhere
    (arms out against arms hanging) get a rest rotation if the clip's skeleton is known.
    """
    ours = {joint.name for joint in character.layout.joints}
    theirs = {name.rsplit(":", 1)[-1]: name for name in clip.joints}
    for preset in PRESETS.values():
        needed = {name for names in targets(preset).values() for name in names}
        if needed <= ours and set(preset.joints) <= set(theirs):
            return _renamed(preset, theirs)
    movable = [joint.name for joint in character.layout.joints if joint.kind in ("ball", "hinge")]
    mine, found = roles.groups(movable), roles.of(clip.joints)
    if "head" not in mine and "head" in found:  # one joint carries neck and head
        found["neck"] = found.pop("head")
    pairs = {found[role]: names for role, names in mine.items() if role in found}
    return Mapping(
        joints={source: to[0] if len(to) == 1 else to for source, to in pairs.items()},
        rest=_rest(character, clip, mine, found) if clip.skeleton else {},
        lift=None,
        ignored=tuple(name for name in clip.joints if name not in pairs),
    )


def _renamed(preset: Mapping, names: dict[str, str]) -> Mapping:
    return dataclasses.replace(
        preset,
        joints={names[source]: to for source, to in preset.joints.items()},
        rest={names[source]: angles for source, angles in preset.rest.items()},
        ignored=tuple(names[source] for source in preset.ignored if source in names),
    )


def _rest(
    character: Character, clip: Clip, mine: dict[str, tuple[str, ...]], found: dict[str, str]
) -> dict[str, tuple[float, float, float]]:
    """Returns the rest rotations that make the character's limbs point as at the clip's zero."""
    assert clip.skeleton is not None
    own, at = joint_positions(character), _at(clip.joints, clip.skeleton)
    rest = {}
    for side in ("left", "right"):
        for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
            carried = Rotation.identity()
            limb = [f"{side}_{part}" for part in chain]
            for upper, lower in zip(limb, limb[1:], strict=False):
                if not (upper in mine and lower in mine and upper in found and lower in found):
                    break
                bone = own[mine[lower][-1]] - own[mine[upper][-1]]
                wanted = carried.inv().apply(at[found[lower]] - at[found[upper]])
                turn = _arc(bone, wanted)
                if np.degrees(turn.magnitude()) > _REST_DEGREES:
                    x, y, z = turn.as_euler("xyz", degrees=True)
                    rest[found[upper]] = (float(x), float(y), float(z))
                    carried = carried * turn
    return rest


def joint_positions(character: Character) -> dict[str, np.ndarray]:
    """Returns where each joint is at the zero pose [3] in m, in the world with x forward."""
    data = mujoco.MjData(character.model)
    mujoco.mj_kinematics(character.model, data)
    face = facing(character)
    names = [joint.name for joint in character.layout.joints]
    return {name: face.apply(data.xanchor[index]) for index, name in enumerate(names)}


def facing(character: Character) -> Rotation:
    """Returns the turn about z that takes the character's `forward` to x."""
    x, y, _ = character.forward
    return Rotation.from_euler("z", -np.arctan2(y, x))


def _at(names: tuple[str, ...], skeleton: Skeleton) -> dict[str, np.ndarray]:
    return dict(zip(names, skeleton.positions(), strict=True))


def _arc(a: np.ndarray, b: np.ndarray) -> Rotation:
    """Returns the shortest rotation from direction `a` to direction `b`."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-9:
        if a @ b > 0:
            return Rotation.identity()
        axis = np.cross(a, [1.0, 0.0, 0.0] if abs(a[0]) < 0.9 else [0.0, 1.0, 0.0])
    angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
