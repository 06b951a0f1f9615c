# SPDX-License-Identifier: Apache-2.0
"""Clips put onto characters: exact where it can be exact, measured where it cannot."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxskills import character, clip, retarget
from jaxskills.character import Character
from jaxskills.clip import roles
from jaxskills.clip.data import Clip, Skeleton, build
from jaxskills.errors import UserError
from jaxskills.retarget import hinges, posed
from jaxskills.retarget.mapping import Mapping

FRAMES = 20


@pytest.fixture(scope="module")
def humanoid() -> Character:
    return character.load("humanoid34")


@pytest.fixture(scope="module")
def jog() -> Clip:
    return clip.load("sparse_jog")


def wander(seed: int, count: int, size: float) -> np.ndarray:
    """Smooth random rotations [FRAMES,count,4] wxyz of up to about `size` rad."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 2 * np.pi, FRAMES)[:, None, None]
    vectors = (
        size * np.sin(time + rng.uniform(0, 6, (1, count, 3))) * rng.uniform(0, 1, (1, count, 3))
    )
    turned = Rotation.from_rotvec(vectors.reshape(-1, 3))
    return turned.as_quat(scalar_first=True).reshape(FRAMES, count, 4)


def some_clip(joints: tuple[str, ...], size: float = 0.8, skeleton: Skeleton | None = None) -> Clip:
    quats = wander(1, len(joints) + 1, size)
    times = np.arange(FRAMES) / 30
    at = np.tile([0.1, 0.2, 0.9], (FRAMES, 1))
    return build(
        "x", "x", times, joints, at, quats[:, 0], quats[:, 1:], loop=False, skeleton=skeleton
    )


def turns_of(model: mujoco.MjModel, qpos: np.ndarray, body: str) -> Rotation:
    """World rotations from the zero pose, by MuJoCo."""
    return Rotation.from_matrix(posed.look(model, qpos).turns[:, model.body(body).id])


def worst(a: Rotation, b: Rotation) -> float:
    return float((a.inv() * b).magnitude().max())


def world_of(one: Clip, *chain: str) -> Rotation:
    """World orientation at the end of a chain of clip joints."""
    turned = Rotation.from_quat(one.root_rot, scalar_first=True)
    for name in chain:
        local = one.rotations[:, one.joints.index(name)]
        turned = turned * Rotation.from_quat(local, scalar_first=True)
    return turned


def test_deepmimic_onto_its_own_humanoid(humanoid: Character, jog: Clip):
    qpos = retarget.retarget(humanoid, jog)
    assert qpos.shape == (len(jog.times), 43) and qpos.dtype == np.float64
    assert qpos[:, :3] == pytest.approx(jog.root_pos)
    assert qpos[:, 3:7] == pytest.approx(jog.root_rot)
    for joint in humanoid.layout.joints[1:]:
        local = jog.rotations[:, jog.joints.index(joint.name)]
        if joint.kind == "ball":
            assert qpos[:, joint.qpos : joint.qpos + 4] == pytest.approx(local)
        else:  # the file format's hinge axis is -y, and knees bend negative about it
            angle = -2 * np.arctan2(local[:, 2], local[:, 0])
            assert qpos[:, joint.qpos] == pytest.approx(angle)
    knee = qpos[:, humanoid.model.joint("left_knee").qposadr[0]]
    assert np.degrees(knee.min()) == pytest.approx(-95, abs=6) and knee.max() < 0


def test_without_a_skeleton_parents_follow_the_character(humanoid: Character, jog: Clip):
    bare = dataclasses.replace(jog, skeleton=None)
    qpos = retarget.retarget(humanoid, bare)
    assert qpos == pytest.approx(retarget.retarget(humanoid, jog), abs=1e-9)


def test_shipped_walk_touches_the_floor(humanoid: Character, deepmimic: Path):
    lowest = posed.look(humanoid.model, retarget.retarget(humanoid, clip.load("walk"))).lowest
    assert lowest.min() == pytest.approx(-0.005, abs=1e-3) and lowest.max() < 0.02


@pytest.mark.parametrize(
    "axes",
    [
        np.eye(3)[[2, 0, 1]],
        np.eye(3)[[2, 1, 0]] * [[1], [-1], [1]],
        Rotation.from_rotvec([0.3, -0.5, 0.2]).apply(np.eye(3)),
    ],
)
def test_three_hinges_are_exact(axes: np.ndarray):
    goal = Rotation.from_quat(wander(2, 1, 2.0)[:, 0], scalar_first=True)
    values = hinges.angles(goal, axes, np.zeros(3))
    assert worst(hinges.compose(values, axes), goal) < 1e-9
    assert np.abs(np.diff(values, axis=0)).max() < 1.5


def test_three_slanted_hinges_are_exact_where_they_can_reach():
    axes = np.array([[0.0, 0.1, 1.0], [1.0, 0.1, 0.0], [0.1, 1.0, -0.1]])
    truth = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    goal = hinges.compose(truth, axes)
    values = np.array([hinges.angles(goal[i : i + 1], axes, truth[i])[0] for i in range(50)])
    assert worst(hinges.compose(values, axes), goal) < 1e-7
    assert values == pytest.approx(truth, abs=1e-6)


def test_two_hinges_keep_the_sole_level():
    """What an ankle of two hinges cannot do is turn about the foot's own vertical."""
    axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    goal = Rotation.from_quat(wander(3, 1, 0.6)[:, 0], scalar_first=True)
    made = hinges.compose(hinges.angles(goal, axes, np.zeros(2)), axes)
    assert made.apply([0, 0, 1]) == pytest.approx(goal.apply([0, 0, 1]), abs=1e-9)


def test_one_hinge_is_unwrapped_and_starts_near_its_range():
    truth = np.linspace(0.5, 9.0, 60)  # more than a full turn
    axis = np.array([[0.0, -1.0, 0.0]])
    goal = Rotation.from_rotvec(truth[:, None] * axis)
    assert hinges.angles(goal, axis, np.array([5.0]))[:, 0] == pytest.approx(truth)
    assert hinges.angles(goal, axis, np.array([-1.5]))[:, 0] == pytest.approx(truth - 2 * np.pi)


def test_atlas_limbs_point_as_the_clip_says(jog: Clip):
    atlas = character.load("atlas")
    moved = retarget.transfer(atlas, jog)
    for joint in ("left_hip", "right_hip", "left_shoulder", "right_shoulder", "chest"):
        assert moved.lost[joint].max() < 1e-6
    for side in ("left", "right"):
        foot = turns_of(atlas.model, moved.qpos, f"{side[0]}_foot")
        wanted = world_of(jog, f"{side}_hip", f"{side}_knee", f"{side}_ankle")
        assert foot.apply([0, 0, 1]) == pytest.approx(wanted.apply([0, 0, 1]), abs=1e-6)
        shin = turns_of(atlas.model, moved.qpos, f"{side[0]}_lleg")
        assert worst(shin, world_of(jog, f"{side}_hip", f"{side}_knee")) < 1e-6
        # Arms are out sideways at Atlas's zero pose and hang at the clip's.
        out = [0, 1, 0] if side == "left" else [0, -1, 0]
        for part, chain in (("uarm", ("shoulder",)), ("larm", ("shoulder", "elbow"))):
            bone = turns_of(atlas.model, moved.qpos, f"{side[0]}_{part}").apply(out)
            limb = world_of(jog, "chest", *(f"{side}_{name}" for name in chain))
            assert bone == pytest.approx(limb.apply([0, 0, -1]), abs=1e-6)
    # SB keeps the human root and lifts it.
    assert moved.qpos[:, :3] - jog.root_pos == pytest.approx(np.tile([0, 0, 0.1], (23, 1)))


def test_human21_limbs_point_as_the_clip_says(jog: Clip):
    human = character.load("human21")
    moved = retarget.transfer(human, jog)
    assert max(lost.max() for lost in moved.lost.values()) < 1e-6
    arm = turns_of(human.model, moved.qpos, "LeftForeArm").apply([0, 1, 0])
    limb = world_of(jog, "chest", "left_shoulder", "left_elbow")
    assert arm == pytest.approx(limb.apply([0, 0, -1]), abs=1e-6)
    assert worst(turns_of(human.model, moved.qpos, "Spine2"), world_of(jog, "chest")) < 1e-6
    # Three spines share the chest's rotation evenly.
    parts = [moved.qpos[:, human.model.joint(n).qposadr[0] :][:, :4] for n in ("Spine", "Spine2")]
    assert parts[0] == pytest.approx(parts[1])
    # Legs are 0.888 m against 0.831 m; the feet are put on the floor.
    assert moved.scale == pytest.approx(0.8890 / 0.8314, abs=2e-3)
    lowest = posed.look(human.model, moved.qpos).lowest
    assert np.quantile(lowest, 0.2) == pytest.approx(0.0, abs=1e-9)


MIXAMO = (
    *("Spine", "Spine1", "Spine2", "Neck", "Head", "LeftShoulder", "LeftArm", "LeftForeArm"),
    *("LeftHand", "RightShoulder", "RightArm", "RightForeArm", "RightHand"),
    *("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    *("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
)
PARENTS = (-1, 0, 1, 2, 3, 2, 5, 6, 7, 2, 9, 10, 11, -1, 13, 14, 15, -1, 17, 18, 19)


def test_arms_out_onto_hanging_arms(humanoid: Character):
    """A T-pose clip with all rotations zero puts our arms out sideways, elbows straight."""
    one = some_clip(MIXAMO, size=0.0, skeleton=Skeleton(PARENTS, np.zeros((21, 3))))
    qpos = retarget.retarget(humanoid, one)
    for side, way in (("left", 1.0), ("right", -1.0)):
        for part in ("shoulder", "elbow"):
            bone = turns_of(humanoid.model, qpos, f"{side}_{part}").apply([0, 0, -1])
            assert bone[0] == pytest.approx([0, way, 0], abs=1e-9)
    assert qpos[0, humanoid.model.joint("left_elbow").qposadr[0]] == pytest.approx(0.0)


def test_chains_with_joints_left_out(humanoid: Character):
    """World orientations survive although spines, neck and collar bones have no counterpart."""
    one = some_clip(MIXAMO, size=0.4, skeleton=Skeleton(PARENTS, np.zeros((21, 3))))
    moved = retarget.transfer(humanoid, one)
    chest = turns_of(humanoid.model, moved.qpos, "chest")
    assert worst(chest, world_of(one, "Spine", "Spine1", "Spine2")) < 1e-6
    foot = turns_of(humanoid.model, moved.qpos, "left_ankle")
    assert worst(foot, world_of(one, "LeftUpLeg", "LeftLeg", "LeftFoot")) < 1e-6
    arm = turns_of(humanoid.model, moved.qpos, "left_shoulder").apply([0, 0, -1])
    limb = world_of(one, "Spine", "Spine1", "Spine2", "LeftShoulder", "LeftArm")
    assert arm == pytest.approx(limb.apply([0, 1, 0]), abs=1e-6)
    # A random knee is no hinge: what is lost is measured.
    knee = moved.lost["LeftLeg"]
    local = Rotation.from_quat(one.rotations[:, one.joints.index("LeftLeg")], scalar_first=True)
    twist = Rotation.from_rotvec(hinges.twist(local, np.array([0.0, 1, 0]))[:, None] * [0.0, 1, 0])
    assert knee.max() > 0.05 and knee == pytest.approx((twist.inv() * local).magnitude())


def test_quaternions_stay_continuous(humanoid: Character, jog: Clip):
    rng = np.random.default_rng(0)
    flipped = dataclasses.replace(
        jog, rotations=jog.rotations * rng.choice([-1.0, 1.0], (23, 12, 1))
    )
    qpos = retarget.retarget(humanoid, flipped)
    assert qpos == pytest.approx(retarget.retarget(humanoid, jog))


@pytest.mark.parametrize(
    "names",
    [
        tuple(f"mixamorig:{name}" for name in MIXAMO),
        ("LowerBack", "Spine", "Neck", "Neck1", "Head", "LHipJoint", "LeftUpLeg", "LeftLeg")
        + ("LeftFoot", "LeftToeBase", "RHipJoint", "RightUpLeg", "RightLeg", "RightFoot")
        + ("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "LThumb")
        + ("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
        ("spine", "head", "thigh.L", "shin.L", "foot.L", "thigh.R", "shin.R", "foot.R")
        + ("upper_arm.L", "forearm.L", "upper_arm.R", "forearm.R"),
        ("lowerback", "head", "lfemur", "ltibia", "lfoot", "rfemur", "rtibia", "rfoot")
        + ("lhumerus", "lradius", "rhumerus", "rradius"),
    ],
    ids=["mixamo", "cmu bvh", "blender", "cmu asf"],
)
def test_guess_by_name(humanoid: Character, names: tuple[str, ...]):
    guess = retarget.guess_mapping(humanoid, some_clip(names))
    driven = {to: source for source, to in guess.joints.items()}
    assert set(driven) == {joint.name for joint in humanoid.layout.joints[1:]}
    for to, words in (
        ("left_hip", ("upleg", "thigh.l", "lfemur")),
        ("right_knee", ("rightleg", "shin.r", "rtibia")),
        ("left_shoulder", ("leftarm", "upper_arm.l", "lhumerus")),
        ("right_elbow", ("rightforearm", "forearm.r", "rradius")),
        ("neck", ("head",)),
    ):
        assert any(word in str(driven[to]).lower() for word in words), driven[to]


def test_guess_rests_arms_by_their_bones(humanoid: Character):
    """An A-pose skeleton: its arms hang at 45 degrees, no preset knows its names."""
    joints = ("chest", "l_arm", "l_forearm", "l_hand", "l_thigh", "l_shin", "l_foot")
    offsets = np.array(
        [[0, 0, 0.3], [0, 0.2, 0.2], [0, 0.2, -0.2], [0, 0.2, -0.2]]
        + [[0, 0.1, 0], [0, 0, -0.5], [0, 0, -0.5]],
        float,
    )
    one = some_clip(joints, size=0.0, skeleton=Skeleton((-1, 0, 1, 2, -1, 4, 5), offsets))
    guess = retarget.guess_mapping(humanoid, one)
    assert set(guess.rest) == {"l_arm"}
    assert guess.rest["l_arm"] == pytest.approx((45, 0, 0), abs=5)
    moved = retarget.transfer(humanoid, one, guess)
    bone = turns_of(humanoid.model, moved.qpos, "left_shoulder").apply([0, 0, -1])[0]
    assert bone == pytest.approx([0, np.sqrt(0.5), -np.sqrt(0.5)], abs=0.02)
    assert moved.scale == pytest.approx(0.8314 / 1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("LeftUpLeg", "left_hip"),
        ("mixamorig:RightForeArm", "right_elbow"),
        ("Bip01 L Thigh", "left_hip"),
        ("r_leg_kny", "right_knee"),
        ("hip_x_right", "right_hip"),
        ("left_hip_pitch_joint", "left_hip"),
        ("Spine2", "trunk"),
        ("LeftHandIndex1", None),
        ("LeftArmTwist", None),
        ("wheel", None),
    ],
)
def test_roles(name: str, role: str | None):
    assert next(iter(roles.groups([name])), None) == role


@pytest.mark.parametrize(
    ("joints", "rest", "said"),
    [
        (
            {"nose": "chest"},
            {},
            "unknown joint of clip 'sparse_jog' 'nose': choose one of chest, neck",
        ),
        ({"chest": "belly"}, {}, "unknown joint of humanoid34 'belly': choose one of chest, neck"),
        ({"chest": "chest", "neck": "chest"}, {}, "driven by both 'chest' and 'neck'"),
        ({"chest": ("chest", "left_knee")}, {}, "cannot drive chest, left_knee"),
        ({"chest": "chest"}, {"neck": (0, 0, 0)}, "unknown joint with a rest rotation 'neck'"),
        ({}, {}, "no joint of clip 'sparse_jog' could be matched"),
    ],
)
def test_refusals(humanoid: Character, jog: Clip, joints: dict, rest: dict, said: str):
    with pytest.raises(UserError, match=said):
        retarget.retarget(humanoid, jog, Mapping(joints, rest=rest))


SIDEWAYS = """<mujoco><worldbody><body name="trunk" pos="0 0 1">
  <freejoint name="root"/><geom size=".1" pos="0 .05 0"/>
  <body name="shin" pos="0 0 -.3"><joint name="left_knee" axis="1 0 0" ref="30"/>
    <geom type="capsule" size=".05 .1" pos="0 0 -.1"/></body>
</body></worldbody></mujoco>"""


def test_character_that_faces_another_way(tmp_path: Path, jog: Clip):
    """Faces +y at its zero pose; its hinge along its own lateral axis, measured from 30 degrees."""
    (tmp_path / "robot.xml").write_text(SIDEWAYS)
    (tmp_path / "robot.toml").write_text("forward = [0.0, 1.0, 0.0]\n")
    robot = character.load(str(tmp_path / "robot.xml"))
    mapping = Mapping({"left_knee": "left_knee"}, scale=1.0)
    moved = retarget.transfer(robot, jog, mapping)
    faces = turns_of(robot.model, moved.qpos, "trunk").apply([0, 1, 0])
    assert faces == pytest.approx(world_of(jog).apply([1, 0, 0]), abs=1e-6)
    # The knee's own turn, relative to a trunk that stands for the thigh as well.
    goal = world_of(jog).inv() * world_of(jog, "left_hip", "left_knee")
    assert moved.qpos[:, 7] == pytest.approx(
        np.radians(30) - hinges.twist(goal, np.array([0.0, 1.0, 0.0])), abs=1e-6
    )


def test_t_pose_is_the_zero_pose_of_human21():
    human = character.load("human21")
    one = some_clip(MIXAMO, size=0.0, skeleton=Skeleton(PARENTS, np.zeros((21, 3))))
    assert retarget.retarget(human, one)[0, 3:] == pytest.approx(human.model.qpos0[3:])
