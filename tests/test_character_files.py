# SPDX-License-Identifier: Apache-2.0
"""The shipped character files: their numbers, their symmetry, their contacts, their stability."""

import importlib.util
import json

import mujoco
import numpy as np
import pytest

from jaxskills import character, paths
from jaxskills.errors import UserError

NAMES = ("humanoid34", "human21", "atlas")
SIDES = (("left_", "right_"), ("Left", "Right"), ("l_", "r_"))

# Joint attachments of the DeepMimic humanoid as its own file has them: y up, z to the right, m.
DEEPMIMIC = {
    "root": (None, (0.0, 0.0, 0.0)),
    "chest": ("root", (0.0, 0.236151, 0.0)),
    "neck": ("chest", (0.0, 0.223894, 0.0)),
    "right_hip": ("root", (0.0, 0.0, 0.084887)),
    "right_knee": ("right_hip", (0.0, -0.421546, 0.0)),
    "right_ankle": ("right_knee", (0.0, -0.409870, 0.0)),
    "right_shoulder": ("chest", (-0.02405, 0.2435, 0.18311)),
    "right_elbow": ("right_shoulder", (0.0, -0.274788, 0.0)),
    "right_wrist": ("right_elbow", (0.0, -0.258947, 0.0)),
    "left_hip": ("root", (0.0, 0.0, -0.084887)),
    "left_knee": ("left_hip", (0.0, -0.421546, 0.0)),
    "left_ankle": ("left_knee", (0.0, -0.409870, 0.0)),
    "left_shoulder": ("chest", (-0.02405, 0.2435, -0.18311)),
    "left_elbow": ("left_shoulder", (0.0, -0.274788, 0.0)),
    "left_wrist": ("left_elbow", (0.0, -0.258947, 0.0)),
}
COLUMNS = {  # first column and width of a joint in a frame
    "root": (4, 4),
    "chest": (8, 4),
    "neck": (12, 4),
    "right_hip": (16, 4),
    "right_knee": (20, 1),
    "right_ankle": (21, 4),
    "right_shoulder": (25, 4),
    "right_elbow": (29, 1),
    "left_hip": (30, 4),
    "left_knee": (34, 1),
    "left_ankle": (35, 4),
    "left_shoulder": (39, 4),
    "left_elbow": (43, 1),
}

needs_clips = pytest.mark.skipif(
    importlib.util.find_spec("pybullet_data") is None, reason="needs the clips extra"
)


@pytest.fixture(scope="module", params=NAMES)
def char(request):
    return character.load(request.param)


@pytest.fixture(scope="module")
def humanoid():
    return character.load("humanoid34")


@pytest.mark.parametrize(
    ("name", "mass", "nq", "nv", "nu", "root"),
    [
        ("humanoid34", 45.0, 43, 34, 28, 0.8814),
        ("human21", 61.7, 91, 69, 63, 1.0528),
        ("atlas", 182.417, 37, 36, 30, 0.9361),
    ],
)
def test_sizes(name, mass, nq, nv, nu, root):
    char = character.load(name)
    model = char.model
    assert char.mass == pytest.approx(mass, abs=1e-3)
    assert (model.nq, model.nv, model.nu) == (nq, nv, nu)
    assert model.qpos0[2] == pytest.approx(root, abs=1e-4)


def test_humanoid_inertia_is_that_of_uniform_geoms(humanoid):
    expected = {
        "chest": (0.0678, 0.0678, 0.0678),
        "right_hip": (0.0563, 0.0563, 0.0065),
        "right_ankle": (0.00093, 0.00286, 0.00329),
    }
    for name, inertia in expected.items():
        assert humanoid.model.body(name).inertia == pytest.approx(inertia, rel=0.01)


def test_feet_touch_the_floor_at_the_zero_pose(char):
    data = mujoco.MjData(char.model)
    mujoco.mj_forward(char.model, data)
    low = {char.model.body(char.model.geom_bodyid[g]).name for g in _shapes_on_floor(char, data)}
    assert low <= set(char.ground)
    assert len(low) >= 2
    assert data.ncon == 0 or data.contact.dist.min() > -1e-6


def test_every_joint_has_its_own_servo(char):
    movable = {joint.name for joint in char.layout.joints if joint.kind != "free"}
    assert set(char.gains) == movable
    assert char.model.nu == char.model.nv - 6
    # A forgotten joint would get kp, kd and torque from the mass.
    assert all(gains.kp != pytest.approx(10.0 * char.mass) for gains in char.gains.values())
    assert char.torque.min() > 0


def test_the_files_hold_no_actuators(char):
    bare = mujoco.MjModel.from_xml_path(char.source)
    assert (bare.nu, bare.nsensor, bare.nkey) == (0, 0, 0)


def test_every_solid_geom_meets_the_floor_and_no_other_contacts_are_implied(char):
    model = char.model
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()
    floor = model.geom("floor").id
    pairs = {frozenset(p) for p in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    assert len(pairs) == model.npair
    for geom in range(model.ngeom):
        seen_only = model.geom(geom).name.endswith("_look")
        if geom != floor:
            assert (frozenset((geom, floor)) in pairs) != seen_only
    assert (model.pair_dim == 3).all()


def test_self_contacts_are_mirrored(humanoid):
    model = humanoid.model
    pairs = {
        frozenset((model.geom(a).name, model.geom(b).name))
        for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
    }
    assert {frozenset(_other_side(name) for name in pair) for pair in pairs} == pairs
    assert sum("floor" not in pair for pair in pairs) == 14


def test_left_mirrors_right(char):
    rng = np.random.default_rng(3)
    model, data = char.model, mujoco.MjData(char.model)
    for _ in range(5):
        pose = model.qpos0.copy()
        mujoco.mj_integratePos(model, pose, rng.normal(0.0, 0.7, model.nv), 1.0)
        mirrored = _mirror_pose(char, pose)
        there = _body_positions(model, data, pose)
        here = _body_positions(model, data, mirrored)
        for i, name in enumerate(char.body_names):
            twin = char.body(_other_side(name))
            # Atlas's own file sets both forearm ends 9 mm along the same local axis.
            loose = char.name == "atlas" and name[2:] in ("lfarm", "hand")
            expected = there[twin] * (1.0, -1.0, 1.0)
            assert here[i] == pytest.approx(expected, abs=0.02 if loose else 1e-9), name


def test_gains_and_limits_are_mirrored(char):
    for name, gains in char.gains.items():
        # The shipped gains of Atlas differ at one shoulder, as in the paper's own code.
        if name[1:] != "_arm_shx":
            assert char.gains[_other_side(name)] == gains
    for name, axes in char.limits.items():
        twin = char.limits[_other_side(name)]
        for axis, (low, high) in axes.items():
            assert tuple(twin[axis]) == ((low, high) if axis == "y" else (-high, -low))


@needs_clips
@pytest.mark.parametrize("clip", ["walk", "cartwheel", "backflip"])
def test_kinematics_equal_those_of_the_motion_format(humanoid, clip):
    text = (paths.deepmimic_dirs()[-1] / f"humanoid3d_{clip}.txt").read_text()
    frames = np.array(json.loads(text)["Frames"])
    data = mujoco.MjData(humanoid.model)
    for frame in frames:
        here = _body_positions(humanoid.model, data, _deepmimic_qpos(humanoid, frame))
        there = _deepmimic_positions(frame)
        for i, name in enumerate(humanoid.body_names):
            x, y, z = there[name]
            assert here[i] == pytest.approx((x, -z, y), abs=1e-9), (clip, name)


def test_humanoid_stands_at_the_zero_pose(humanoid):
    data = _simulate(humanoid, seconds=5.0, spread=0.0)
    assert data.qpos[2] == pytest.approx(0.8814, abs=0.005)


@pytest.mark.parametrize("seed", [0, 1])
def test_wild_targets_do_not_blow_up(char, seed):
    data = _simulate(char, seconds=4.0, spread=1.0, seed=seed)
    assert np.isfinite(data.qpos).all()
    assert data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number == 0


def _simulate(char, seconds, spread, seed=0):
    """Plays random targets at 30 Hz within torque/kp of the joint, at the default time step."""
    rng = np.random.default_rng(seed)
    model, data = char.model, mujoco.MjData(char.model)
    mujoco.mj_forward(model, data)
    reach = char.torque / char.kp
    for _ in range(round(30 * seconds)):
        now = data.actuator_length
        data.ctrl[:] = np.clip(rng.normal(0.0, spread, model.nu), now - reach, now + reach)
        for _ in range(round(1.0 / 30.0 / model.opt.timestep)):
            mujoco.mj_step(model, data)
            assert np.abs(data.qvel[6:]).max() < 60.0
    return data


def _shapes_on_floor(char, data):
    """Returns the boxes whose lower face lies within 0.1 mm of the floor."""
    model = char.model
    boxes = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
    bottom = {g: data.geom_xpos[g, 2] - model.geom_size[g, 2] for g in boxes}
    assert min(bottom.values()) > -1e-6
    return [g for g in boxes if bottom[g] < 1e-4]


def _other_side(name):
    for left, right in SIDES:
        if name.startswith(left):
            return right + name[len(left) :]
        if name.startswith(right):
            return left + name[len(right) :]
    return name


def _body_positions(model, data, qpos):
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data.xpos[1:].copy()


def _mirror_pose(char, pose):
    """Reflects a pose in the plane y = 0, limbs exchanged."""
    model, data = char.model, mujoco.MjData(char.model)
    mujoco.mj_kinematics(model, data)
    flip = np.array([-1.0, 1.0, -1.0])  # of a rotation axis under the reflection
    out = pose.copy()
    for joint in range(model.njnt):
        twin = model.joint(_other_side(model.joint(joint).name)).id
        to, source = model.jnt_qposadr[joint], model.jnt_qposadr[twin]
        kind = model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_HINGE:
            sign = np.sign(data.xaxis[joint] @ (flip * data.xaxis[twin]))
            out[to] = sign * pose[source]
            continue
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            out[to : to + 3] = pose[source : source + 3] * (1.0, -1.0, 1.0)
            to, source = to + 3, source + 3
        out[to : to + 4] = pose[source : source + 4] * (1.0, *flip)
    return out


def _deepmimic_qpos(humanoid, frame):
    qpos = humanoid.model.qpos0.copy()
    qpos[:3] = frame[1], -frame[3], frame[2]
    for joint in range(humanoid.model.njnt):
        first, width = COLUMNS[humanoid.model.joint(joint).name]
        at = humanoid.model.jnt_qposadr[joint] + (3 if joint == 0 else 0)
        if width == 1:
            qpos[at] = frame[first]
        else:
            w, x, y, z = frame[first : first + 4]
            qpos[at : at + 4] = w, x, -z, y
    return qpos


def _deepmimic_positions(frame):
    """Forward kinematics in the motion format's own axes, with rotation matrices."""
    turns: dict[str | None, np.ndarray] = {None: np.eye(3)}
    places: dict[str | None, np.ndarray] = {None: frame[1:4]}
    for name, (parent, offset) in DEEPMIMIC.items():
        places[name] = places[parent] + turns[parent] @ np.array(offset)
        turns[name] = turns[parent] @ _local_turn(name, frame)
    return places


def _local_turn(name, frame):
    if name not in COLUMNS:
        return np.eye(3)
    first, width = COLUMNS[name]
    if width == 1:
        c, s = np.cos(frame[first]), np.sin(frame[first])
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    quat = frame[first : first + 4]
    w, (x, y, z) = quat[0], quat[1:]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # R = I + 2 (w K + K K) / |q|^2 holds for quaternions that are not of unit length, too.
    return np.eye(3) + 2.0 * (w * cross + cross @ cross) / (quat @ quat)


def test_bodies_by_pattern():
    who = character.load("humanoid34")
    assert who.bodies(("*",)) == set(range(15))
    names = {who.body_names[i] for i in who.bodies(("*_knee", "root"))}
    assert names == {"right_knee", "left_knee", "root"}
    with pytest.raises(UserError, match=r"unknown body of humanoid34 '\*_toe': choose one of root"):
        who.bodies(("root", "*_toe"))
