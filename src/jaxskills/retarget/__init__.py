# SPDX-License-Identifier: Apache-2.0
"""A clip put onto a character: poses in MuJoCo's `qpos`, frame by frame.

Orientations are matched in the world: a mapped limb turns from its rest pose as the clip's limb
turns from the clip's zero pose, so joints between mapped ones (spines, clavicles) may be missing on
either side. What a hinge cannot take is measured, and made up by the next joint that can.
"""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills.character import Character
from jaxskills.clip import roles
from jaxskills.clip.data import Clip
from jaxskills.errors import UserError, unknown
from jaxskills.retarget import hinges, posed
from jaxskills.retarget.mapping import Mapping, facing, guess_mapping, joint_positions, targets

__all__ = ["Mapping", "Transfer", "guess_mapping", "retarget", "transfer"]

# With an automatic lift, this share of the frames may have their lowest point in the floor.
_LOW_SHARE = 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Transfer:
    """A clip on a character, and what it took."""

    qpos: np.ndarray  # [F,nq]
    mapping: Mapping  # the one used, guessed if none was given
    scale: float  # root positions were multiplied by this
    lift: float  # m, then raised by this
    lost: dict[str, np.ndarray]  # clip joint -> [F] rad its hinges could not take


def retarget(character: Character, clip: Clip, mapping: Mapping | None = None) -> np.ndarray:
    """Returns the clip's poses on the character, `qpos [F,nq]`, float64.

    Ball joints get the rotation, a tuple of them equal shares; a hinge gets the twist about its
    axis, two or three hinges Euler angles in their order. Quaternions and angles are continuous
    along the frames. Unmapped joints stay at the zero pose.

    Args:
      character: what to pose.
      clip: the motion.
      mapping: which joint drives which; guessed from the names if None.

    Raises:
      UserError: a joint name the clip or the character does not have; the message lists them.
    """
    return transfer(character, clip, mapping).qpos


def transfer(character: Character, clip: Clip, mapping: Mapping | None = None) -> Transfer:
    """Returns `retarget`'s poses together with scale, lift and what hinges lost."""
    mapping = guess_mapping(character, clip) if mapping is None else mapping
    _check(character, clip, mapping)
    model = character.model
    qpos = np.tile(model.qpos0, (len(clip.times), 1))
    lost = _pose(character, clip, mapping, qpos)
    scale = _scale(character, clip) if mapping.scale is None else mapping.scale
    qpos[:, :3] = scale * clip.root_pos
    lift = mapping.lift
    if lift is None:
        lift = float(-np.quantile(posed.look(model, qpos).lowest, _LOW_SHARE))
    qpos[:, 2] += lift
    return Transfer(qpos, mapping, scale, lift, lost)


def _pose(character: Character, clip: Clip, mapping: Mapping, qpos: np.ndarray) -> dict:
    """Writes the rotations of all joints into `qpos`; returns what hinges lost.

    All rotations are written in axes that are the world's at the zero pose: `turned[b]` takes body
    b from its zero pose to its pose, and joint axes are those of the zero pose.
    """
    model = character.model
    zero = _zero_pose(model)
    sources = {name: source for source, names in targets(mapping).items() for name in names}
    world = _orientations(clip)
    turned: dict[int, Rotation] = {0: Rotation.identity()}
    rest: dict[int, Rotation] = {0: Rotation.identity()}
    source_of: dict[int, str] = {0: "root"}  # the clip joint that moves a body
    lost = {}
    open_group: dict[str, tuple[Rotation, Rotation, str]] = {}
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        turned[body], rest[body], source_of[body] = turned[parent], rest[parent], source_of[parent]
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            name = model.joint(joint).name
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                rest[body] = facing(character) * _rest_of(mapping, "root")
                turned[body] = world["root"] * rest[body]
                address = model.jnt_qposadr[joint] + 3
                qpos[:, address : address + 4] = _quat(turned[body] * zero[body])
            elif name in sources:
                source = sources[name]
                names = targets(mapping)[source]
                if name == names[0]:
                    open_group[source] = (turned[body], rest[body], source_of[body])
                if name == names[-1]:
                    before, resting, above = open_group[source]
                    rest[body] = resting * _rest_of(mapping, source)
                    if source not in world:
                        world[source] = world[above] * _local(clip, source)
                    goal = world[source] * rest[body]
                    reached = _solve(model, names, zero, before.inv() * goal, qpos)
                    turned[body], source_of[body] = before * reached, source
                    lost[source] = (turned[body].inv() * goal).magnitude()
    return lost


def _orientations(clip: Clip) -> dict[str, Rotation]:
    """Returns world orientations: of the root, and of all joints if the parents are known."""
    world = {"root": Rotation.from_quat(clip.root_rot, scalar_first=True)}
    if clip.skeleton is not None:
        for joint in _parents_first(clip.skeleton.parents):
            parent = clip.skeleton.parents[joint]
            above = world[clip.joints[parent] if parent >= 0 else "root"]
            world[clip.joints[joint]] = above * _local(clip, clip.joints[joint])
    return world


def _parents_first(parents: tuple[int, ...]) -> list[int]:
    def depth(joint: int) -> int:
        return 0 if joint < 0 else 1 + depth(parents[joint])

    return sorted(range(len(parents)), key=depth)


def _local(clip: Clip, joint: str) -> Rotation:
    return Rotation.from_quat(clip.rotations[:, clip.joints.index(joint)], scalar_first=True)


def _solve(
    model: mujoco.MjModel,
    names: tuple[str, ...],
    zero: list[Rotation],
    turn: Rotation,
    qpos: np.ndarray,
) -> Rotation:
    """Writes the joints `names` so that together they make `turn`; returns what they make."""
    joints = [model.joint(name).id for name in names]
    addresses = [int(model.jnt_qposadr[joint]) for joint in joints]
    bodies = [int(model.jnt_bodyid[joint]) for joint in joints]
    if model.jnt_type[joints[0]] == mujoco.mjtJoint.mjJNT_BALL:
        share = Rotation.from_rotvec(turn.as_rotvec() / len(joints))
        for address, body in zip(addresses, bodies, strict=True):
            qpos[:, address : address + 4] = _quat(zero[body].inv() * share * zero[body])
        return turn
    pairs = zip(joints, bodies, strict=True)
    axes = np.array([zero[body].apply(model.jnt_axis[joint]) for joint, body in pairs])
    limited = model.jnt_limited[joints] != 0
    middles = np.where(limited, model.jnt_range[joints].mean(axis=1), 0.0)
    values = hinges.angles(turn, axes, middles)
    qpos[:, addresses] = model.qpos0[addresses] + values
    return hinges.compose(values, axes)


def _zero_pose(model: mujoco.MjModel) -> list[Rotation]:
    """Returns the orientation of each body at the zero pose."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return [Rotation.from_quat(quat, scalar_first=True) for quat in data.xquat]


def _rest_of(mapping: Mapping, source: str) -> Rotation:
    return Rotation.from_euler("xyz", mapping.rest.get(source, (0.0, 0.0, 0.0)), degrees=True)


def _quat(rotation: Rotation) -> np.ndarray:
    """Returns quaternions [F,4] wxyz, continuous in sign, the first with w >= 0."""
    quat = rotation.as_quat(scalar_first=True)
    signs = np.cumprod(np.where(np.sum(quat[1:] * quat[:-1], axis=1) < 0, -1.0, 1.0))
    quat[1:] *= signs[:, None]
    return quat if quat[0, 0] >= 0 else -quat


def _scale(character: Character, clip: Clip) -> float:
    """Returns the character's leg length over the clip's, 1 if either is unknown."""
    theirs = roles.leg_length(clip.joints, clip.skeleton) if clip.skeleton else None
    at = joint_positions(character)
    mine = roles.of(tuple(at))
    if theirs is None or not {"left_hip", "left_knee", "left_ankle"} <= set(mine):
        return 1.0
    points = [at[mine[f"left_{part}"]] for part in ("hip", "knee", "ankle")]
    length = np.linalg.norm(points[1] - points[0]) + np.linalg.norm(points[2] - points[1])
    return float(length / theirs)


def _check(character: Character, clip: Clip, mapping: Mapping) -> None:
    allowed = {joint.name: joint for joint in character.layout.joints if joint.kind != "free"}
    used: dict[str, str] = {}
    if not mapping.joints:
        raise UserError(
            f"no joint of clip '{clip.name}' could be matched to {character.name}: give a Mapping"
            f" from {', '.join(clip.joints)} to {', '.join(allowed)}"
        )
    for source, names in targets(mapping).items():
        if source not in clip.joints:
            raise unknown(f"joint of clip '{clip.name}'", source, clip.joints)
        for name in names:
            if name not in allowed:
                raise unknown(f"joint of {character.name}", name, tuple(allowed))
            if name in used:
                raise UserError(f"joint '{name}' is driven by both '{used[name]}' and '{source}'")
            used[name] = source
        kinds = {allowed[name].kind for name in names}
        if kinds != {"ball"} and (kinds != {"hinge"} or len(names) > 3):
            raise UserError(
                f"clip joint '{source}' cannot drive {', '.join(names)}: choose one or more ball"
                " joints, or one to three hinges"
            )
    for source in mapping.rest:
        if source != "root" and source not in mapping.joints:
            raise unknown("joint with a rest rotation", source, ("root", *mapping.joints))
