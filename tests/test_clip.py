# SPDX-License-Identifier: Apache-2.0
"""Clip files: the numbers that come out, what is absorbed, what is refused and how it is said."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from jaxskills import clip
from jaxskills.errors import UserError

UPRIGHT = [1.0, 0.0, 0.0, 0.0]
HALF = np.sqrt(0.5)

# The DeepMimic humanoid in its own axes (x forward, y up, z right): offset in the parent, columns.
RIGHT_LEG = (
    ((0.0, 0.0, 0.084887), slice(16, 20)),
    ((0.0, -0.421546, 0.0), 20),
    ((0.0, -0.409870, 0.0), slice(21, 25)),
)


def frame(duration: float = 0.1, **columns: list) -> list[float]:
    """One DeepMimic frame of 44 numbers, upright at 0.9 m; `c8=[...]` overwrites from column 8."""
    row = [duration, 0.0, 0.9, 0.0, *UPRIGHT, *UPRIGHT, *UPRIGHT]
    for _ in range(2):
        row += [*UPRIGHT, 0.0, *UPRIGHT, *UPRIGHT, 0.0]
    for name, values in columns.items():
        first = int(name[1:])
        row[first : first + len(values)] = values
    return row


def write(path: Path, frames: list, loop: str = "wrap") -> Path:
    path.write_text(json.dumps({"Loop": loop, "Frames": frames}))
    return path


def matrix(quat: np.ndarray) -> np.ndarray:
    """The rotation matrix of a wxyz quaternion, from the textbook formula."""
    w, x, y, z = np.asarray(quat) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def joint_position(one: clip.Clip, name: str, index: int) -> np.ndarray:
    """World position of a joint from a clip's own skeleton and rotations."""
    assert one.skeleton is not None
    chain, joint = [], one.joints.index(name)
    while joint >= 0:
        chain.append(joint)
        joint = one.skeleton.parents[joint]
    at, turned = one.root_pos[index].copy(), matrix(one.root_rot[index])
    for joint in reversed(chain):
        at += turned @ one.skeleton.offsets[joint]
        turned = turned @ matrix(one.rotations[index, joint])
    return at


def test_deepmimic_columns(tmp_path: Path):
    frames = [
        frame(0.1),
        frame(0.1, c1=[1.0, 0.8, 0.25], c4=[HALF, 0, HALF, 0], c20=[-np.pi / 2]),
        frame(99.0),  # the last duration means nothing
    ]
    one = clip.load(write(tmp_path / "humanoid3d_try.txt", frames))
    assert one.name == "try" and one.loop
    assert one.times == pytest.approx([0.0, 0.1, 0.2])
    assert one.duration == pytest.approx(0.2) and one.rate == pytest.approx(10.0)
    assert len(one.joints) == 12 and one.joints[:4] == ("chest", "neck", "right_hip", "right_knee")
    # x forward, y up, z right becomes x forward, y left, z up.
    assert one.root_pos[1] == pytest.approx([1.0, -0.25, 0.8])
    # A quarter turn about y (up) is one about z; about z (right) by -90 is about +y by 90 degrees.
    assert one.root_rot[1] == pytest.approx([HALF, 0, 0, HALF])
    assert one.rotations[1, 3] == pytest.approx([HALF, 0, HALF, 0])
    assert one.file_angles["right_knee"] == pytest.approx(np.pi / 2)
    assert one.notes == ()


def test_z_up_is_the_same_motion(tmp_path: Path):
    """The ankle, by forward kinematics in the file's axes and in ours."""
    rng = np.random.default_rng(0)
    frames = []
    for _ in range(5):
        row = np.array(frame())
        row[1:4] += rng.normal(size=3)
        for column in (4, 16, 21):
            row[column : column + 4] = rng.normal(size=4)
        row[20] = rng.uniform(-3, 0)
        frames.append(row)
    one = clip.load(write(tmp_path / "x.json", [row.tolist() for row in frames]))
    for index, row in enumerate(frames):
        at, turned = row[1:4].copy(), matrix(row[4:8])
        for offset, columns in RIGHT_LEG:
            at += turned @ np.array(offset)
            local = matrix(row[columns]) if isinstance(columns, slice) else about_z(row[columns])
            turned = turned @ local
        x, y, z = at
        assert joint_position(one, "right_ankle", index) == pytest.approx([x, -z, y], abs=1e-9)


def test_absorbs_and_says_so(tmp_path: Path):
    turn = np.array([np.cos(0.3), 0, 0, np.sin(0.3)])
    frames = [
        frame(0.1, c8=(turn * 1.2).tolist()),
        frame(0.1, c8=(-turn).tolist()),
        frame(0.3, c8=turn.tolist()),
        frame(0.1),
    ]
    one = clip.load(write(tmp_path / "x.txt", frames, "none"))
    assert not one.loop
    chest = one.rotations[:, 0]
    assert np.linalg.norm(chest, axis=-1) == pytest.approx(np.ones(4))
    assert (np.sum(chest[1:] * chest[:-1], axis=-1) > 0).all() and chest[0, 0] > 0
    assert chest[0] == pytest.approx(chest[1])
    notes = " | ".join(one.notes)
    assert "1 quaternions normalised (worst norm error 0.2)" in notes
    assert "2 sign flips" in notes
    assert "1 of 3 frames last longer or shorter than 0.1 s (frame 2: 0.3 s)" in notes


def _broken_frames() -> list[tuple[str, str]]:
    def text(frames: list) -> str:
        return json.dumps({"Loop": "wrap", "Frames": frames})

    good = frame()
    return [
        ("", "is empty"),
        ("  \n", "is empty"),
        (text([good, good])[:-40], "truncated"),
        ("walk like an egyptian", "is not JSON"),
        ("[1, 2]", "not a DeepMimic motion file"),
        ('{"Loop": "wrap"}', "not a DeepMimic motion file"),
        ('{"Loop": "always", "Frames": []}', "unknown Loop"),
        (text([]), "has 0 frame(s): at least 2"),
        (text([good]), "has 1 frame(s): at least 2"),
        (text([good, good[:-1]]), "frame 1 has 43 numbers: expected 44"),
        (text([good, 3.0]), "frame 1 is not a list"),
        (text([good, frame(c20=[float("nan")]), good]), "frame 1, column 20 (right_knee) is nan"),
        (text([frame(c2=[float("inf")]), good]), "frame 0, column 2 (root position) is inf"),
        (text([good, frame(c9=["0"])]), "frame 1, column 9 (chest) is 0"),
        (text([good, frame(c9=[None])]), "frame 1, column 9 (chest) is None"),
        (text([frame(0.0), good]), "frame 0 lasts 0 s: durations must be > 0"),
        (text([good, frame(-0.1), good]), "frame 1 lasts -0.1 s"),
        (text([good, frame(c16=[0, 0, 0, 0])]), "frame 1: the quaternion of right_hip is zero"),
    ]


@pytest.mark.parametrize(("content", "said"), _broken_frames(), ids=lambda value: value[-30:])
def test_refuses_broken_deepmimic(tmp_path: Path, content: str, said: str):
    path = tmp_path / "bad.txt"
    path.write_text(content)
    with pytest.raises(UserError) as error:
        clip.load(path)
    assert said in str(error.value) and "bad.txt" in str(error.value)
    assert "\n" not in str(error.value)


def test_refuses_what_is_no_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "notes.docx").write_text("x")
    (tmp_path / "folder.txt").mkdir()
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00\x81")
    monkeypatch.setenv("JAXSKILLS_CLIP_DIR", str(tmp_path))
    for name, said in (
        ("missing.txt", "does not exist"),
        ("folder.txt", "is a folder"),
        ("notes.docx", "no known format"),
        ("bytes.txt", "cannot be read"),
    ):
        with pytest.raises(UserError, match=said):
            clip.load(tmp_path / name)
    with pytest.raises(UserError, match="unknown clip 'wlak': choose one of .*sparse_jog"):
        clip.load("wlak")


def test_npz_keeps_everything(tmp_path: Path):
    frames = [frame(c8=[2.0, 0, 0, 0]), frame(0.2, c20=[-1.0]), frame()]
    one = clip.load(write(tmp_path / "a.txt", frames))
    two = clip.load(clip.save(one, tmp_path / "b.npz"))
    for field in ("times", "root_pos", "root_rot", "rotations"):
        assert np.array_equal(getattr(two, field), getattr(one, field))
    assert (two.name, two.joints, two.loop) == (one.name, one.joints, one.loop)
    assert one.notes and two.notes[: len(one.notes)] == one.notes
    assert two.file_angles == one.file_angles
    assert one.skeleton and two.skeleton and two.skeleton.parents == one.skeleton.parents
    assert np.array_equal(two.skeleton.offsets, one.skeleton.offsets)


def test_refuses_broken_npz(tmp_path: Path):
    path = tmp_path / "bad.npz"
    path.write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(UserError, match="not a sound npz"):
        clip.load(path)
    np.savez(path, times=np.arange(3.0))
    with pytest.raises(UserError, match="lacks joints, root_pos, root_rot, rotations"):
        clip.load(path)
    quats = np.tile(UPRIGHT, (3, 1))
    good = {"joints": ["a"], "root_pos": np.zeros((3, 3)), "root_rot": quats}
    np.savez(path, times=np.array([0.0, 0.1, 0.1]), rotations=quats[:, None], **good)
    with pytest.raises(UserError, match="frame 1 lasts 0 s"):
        clip.load(path)
    np.savez(path, times=np.arange(3.0), rotations=quats, **good)
    with pytest.raises(UserError, match=r"rotations \[3, 4\]: expected .* \[3, 1, 4\]"):
        clip.load(path)
    with pytest.raises(UserError, match="saved as .npz"):
        clip.save(clip.load("sparse_jog"), tmp_path / "x.txt")


BVH = """HIERARCHY
ROOT Hips
{{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Head
  {{
    OFFSET {head}
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {{
      OFFSET 0 0 0
    }}
  }}
{legs}}}
MOTION
Frames: 2
Frame Time: 0.033333
{motion}
"""
LEG = """  JOINT {side}UpLeg
  {{
    OFFSET {hip}
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT {side}Leg
    {{
      OFFSET {knee}
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT {side}Foot
      {{
        OFFSET {ankle}
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {{
          OFFSET {toe}
        }}
      }}
    }}
  }}
"""


def bvh(path: Path, motion: list[list[float]], axes: str = "xyz", unit: float = 100.0) -> Path:
    """Writes a small BVH; `axes` says which file axis left, up and forward are ('xyz' is Mixamo's).

    Joints in order: Hips, Head, LeftUpLeg, LeftLeg, LeftFoot, RightUpLeg, RightLeg, RightFoot.
    """

    def offset(left: float, up: float, forward: float) -> str:
        values = dict(zip(axes, (left, up, forward), strict=True))
        return " ".join(f"{unit * values[axis]:.6f}" for axis in "xyz")

    legs = "".join(
        LEG.format(
            side=side,
            hip=offset(y, -0.1, 0),
            knee=offset(0, -0.4, 0),
            ankle=offset(0, -0.42, 0),
            toe=offset(0, -0.05, 0.1),
        )
        for side, y in (("Left", 0.1), ("Right", -0.1))
    )
    rows = "\n".join(" ".join(map(str, row)) for row in motion)
    path.write_text(BVH.format(head=offset(0, 0.6, 0), legs=legs, motion=rows))
    return path


def test_bvh_known_pose(tmp_path: Path):
    pytest.importorskip("pybvh")
    still = [0.0, 97.0, 0.0] + [0.0] * 24
    posed = list(still)
    posed[:6] = [10.0, 97.0, 30.0, 0.0, 0.0, 90.0]  # 0.3 m forward, 0.1 m left; quarter turn left
    posed[3 + 6 : 3 + 9] = [0.0, -30.0, 0.0]  # LeftUpLeg swings forward about -x (to the right)
    one = clip.load(bvh(tmp_path / "x.bvh", [still, posed]))
    assert one.times == pytest.approx([0.0, 1 / 30], abs=1e-6) and not one.loop
    assert one.joints[:3] == ("Head", "LeftUpLeg", "LeftLeg")
    assert one.root_pos[1] == pytest.approx([0.3, 0.1, 0.97])
    assert one.root_rot[1] == pytest.approx([HALF, 0, 0, HALF])
    swing = np.radians(30.0) / 2
    assert one.rotations[1, 1] == pytest.approx([np.cos(swing), 0, -np.sin(swing), 0])
    # Turned left, forward is +y: the foot is at 0.82 m along the swung leg.
    at = joint_position(one, "LeftFoot", 1)
    swung = 0.82 * np.array([np.sin(np.radians(30)), np.cos(np.radians(30))])
    assert at == pytest.approx([0.3 - 0.1, 0.1 + swung[0], 0.97 - 0.1 - swung[1]])
    assert any("centimetres" in note for note in one.notes)
    assert any("+y is up and +z forward" in note for note in one.notes)


@pytest.mark.parametrize(
    ("unit", "name"), [(1.0, "metres"), (1000.0, "millimetres"), (39.37, "inches"), (17.7, "CMU")]
)
def test_bvh_units(tmp_path: Path, unit: float, name: str):
    pytest.importorskip("pybvh")
    rows = [[0.0, 0.97 * unit, 0.0] + [0.0] * 24] * 2
    one = clip.load(bvh(tmp_path / "x.bvh", rows, unit=unit))
    assert one.root_pos[0] == pytest.approx([0, 0, 0.97], abs=0.01)
    assert any(name in note for note in one.notes)


def test_bvh_z_up(tmp_path: Path):
    """Left is x, up z, forward -y would be a mirror; here left y, up z, forward x."""
    pytest.importorskip("pybvh")
    row = [30.0, 10.0, 97.0] + [0.0] * 24
    one = clip.load(bvh(tmp_path / "x.bvh", [row, row], axes="yzx"))
    assert one.root_pos[0] == pytest.approx([0.3, 0.1, 0.97])
    assert any("+z is up and +x forward" in note for note in one.notes)


def test_bvh_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("pybvh")
    row = [0.0, 97.0, 0.0] + [0.0] * 24
    good = bvh(tmp_path / "x.bvh", [row, row]).read_text()
    for text in ("", "not a bvh", good[:300], good.replace("Frames: 2", "Frames: 3")):
        (tmp_path / "bad.bvh").write_text(text)
        with pytest.raises(UserError, match="bad.bvh"):
            clip.load(tmp_path / "bad.bvh")
    with pytest.raises(UserError, match="frame 1"):
        clip.load(bvh(tmp_path / "nan.bvh", [row, [float("nan"), *row[1:]]]))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'jaxskills\[bvh\]'"):
        clip.load(tmp_path / "x.bvh")


def test_names_without_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("JAXSKILLS_CLIP_DIR", str(tmp_path))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    ours = ["dodge", "pivot", "push", "sparse_backward_jog", "sparse_high_knees", "sparse_jog"]
    ours += ["swing", "wall_jump"]
    assert clip.available() == ours
    write(tmp_path / "humanoid3d_hop.txt", [frame(), frame()])
    assert clip.available() == sorted(["hop", *ours])
    assert clip.load("hop").name == "hop"


def test_own_clips_come_beside_the_extras_and_win(
    deepmimic: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setenv("JAXSKILLS_CLIP_DIR", str(tmp_path))
    write(tmp_path / "humanoid3d_hop.txt", [frame(), frame()])
    assert {"hop", "walk"} <= set(clip.available())
    assert clip.find("walk") == deepmimic / "humanoid3d_walk.txt"
    write(tmp_path / "humanoid3d_walk.txt", [frame(), frame()])
    assert clip.find("walk") == tmp_path / "humanoid3d_walk.txt"


@pytest.mark.parametrize(
    ("name", "frames", "seconds"),  # SB Table 1 lists 1.26, 0.80, 1.77, 2.02, 2.72, 1.62, 1.75 s
    [
        ("walk", 39, 1.267),
        ("run", 25, 0.800),
        ("jump", 107, 1.767),
        ("roll", 121, 2.016),
        ("cartwheel", 164, 2.717),
        ("dance_a", 98, 1.617),
        ("backflip", 29, 1.750),
        ("walker/turn_left0", 38, 1.233),
    ],
)
def test_shipped_lengths(deepmimic: Path, name: str, frames: int, seconds: float):
    one = clip.load(name)
    assert name in clip.available()
    assert len(one.times) == frames and one.duration == pytest.approx(seconds, abs=6e-4)


def test_a_part_of_a_clip(tmp_path: Path):
    whole = clip.load(
        write(tmp_path / "four.txt", [frame(0.1, c1=[i, 1.0, 0.0]) for i in range(4)])
    )
    part = clip.cut(whole, 0.1, 0.2)
    np.testing.assert_allclose(part.times, [0.0, 0.1])
    np.testing.assert_array_equal(part.root_pos, whole.root_pos[1:3])
    np.testing.assert_array_equal(part.rotations, whole.rotations[1:3])
    assert not part.loop and part.joints == whole.joints
    assert clip.cut(whole, 0.0, None) is whole
    with pytest.raises(
        UserError, match="motion.start 0.25 to motion.end 0.3: clip .* has 1 frames"
    ):
        clip.cut(whole, 0.25, 0.3)


def test_a_loop_done_once(tmp_path: Path):
    """Without the frame with which it starts anew; what does not loop stays as it is."""
    frames = [frame(0.1, c1=[i, 1.0, 0.0]) for i in range(4)]
    whole = clip.load(write(tmp_path / "four.txt", frames))
    single = clip.once(dataclasses.replace(whole, loop=True))
    assert not single.loop and len(single.times) == len(whole.times) - 1
    np.testing.assert_array_equal(single.root_pos, whole.root_pos[:-1])
    once = dataclasses.replace(whole, loop=False)
    assert clip.once(once) is once
