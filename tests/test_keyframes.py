# SPDX-License-Identifier: Apache-2.0
"""Key poses made into clips."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxskills import character, check, clip
from jaxskills.clip import keyframes
from jaxskills.clip.keyframes import Key, Keyframes
from jaxskills.errors import UserError
from jaxskills.retarget import hinges

TOML = """
loop = false
interpolation = "linear"
rate = 10

[joints]
root = "zyx"
right_hip = "-yxz"
right_knee = "y"

[[poses]]
time = 0.0
position = [0.0, 0.0, 0.9]
right_knee = 0
right_hip = [0, 0, 0]

[[poses]]
time = 0.5
right_knee = 80

[[poses]]
time = 1.0
position = [1.0, 0.0, 0.8]
root = [90, 0, 0]
right_hip = [60, 0, 0]
right_knee = 40
"""


def half(degrees: float) -> tuple[float, float]:
    return np.cos(np.radians(degrees) / 2), np.sin(np.radians(degrees) / 2)


def test_linear(tmp_path: Path):
    path = tmp_path / "kick.toml"
    path.write_text(TOML)
    one = clip.load(path)
    assert one.name == "kick" and not one.loop
    assert one.times == pytest.approx(np.linspace(0, 1, 11))
    assert one.root_pos[5] == pytest.approx([0.5, 0.0, 0.85])
    knee, hip = one.joints.index("right_knee"), one.joints.index("right_hip")
    for index, degrees in ((0, 0), (2, 32), (5, 80), (10, 40)):
        c, s = half(degrees)
        assert one.rotations[index, knee] == pytest.approx([c, 0, s, 0], abs=1e-12)
    c, s = half(30)  # half way, though the second pose does not name the hip; forward is about -y
    assert one.rotations[5, hip] == pytest.approx([c, 0, -s, 0])
    assert len(one.joints) == 12 and one.skeleton is not None
    # The root is named once: it holds.
    assert one.root_rot[0] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_axes_turn_in_the_stated_order():
    made = Keyframes("x", {"arm": "zx"}, [Key(0.0, {"arm": (90, 90)}, (0, 0, 1)), Key(1.0, {})])
    # Turned about z by 90 and then about its own new x: its z axis points along the world's x.
    w, x, y, z = keyframes.compile(made).rotations[0, 0]
    up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    assert up == pytest.approx([1, 0, 0], abs=1e-12)


def _loop(interpolation: str) -> Keyframes:
    keys = [
        Key(0.0, {"knee": 10, "hip": (20, 5, 0)}, (0.0, 0.0, 0.9)),
        Key(0.3, {"knee": 60, "hip": (-20, 0, 10)}, (0.45, 0.0, 0.8)),
        Key(0.6, {"knee": 30, "hip": (0, -5, 0)}, (0.80, 0.0, 0.95)),
    ]
    axes = {"knee": "y", "hip": "yxz"}
    return Keyframes("x", axes, keys, interpolation, True, 0.9, (1.2, 0.0, 0.0), rate=100.0)


@pytest.mark.parametrize("interpolation", keyframes.INTERPOLATIONS)
def test_loop_closes_and_passes_through_keys(interpolation: str):
    one = keyframes.compile(_loop(interpolation))
    assert one.loop and one.duration == pytest.approx(0.9)
    assert one.rotations[-1] == pytest.approx(one.rotations[0], abs=1e-9)
    assert one.root_pos[-1] - one.root_pos[0] == pytest.approx([1.2, 0, 0], abs=1e-9)
    assert one.root_pos[30] == pytest.approx([0.45, 0, 0.8], abs=1e-9)
    c, s = half(60)
    assert one.rotations[30, 0] == pytest.approx([c, 0, s, 0], abs=1e-9)


def test_spline_is_smooth_where_linear_is_not():
    """The largest change of speed from one frame to the next, also across the seam."""
    jolts = {}
    for interpolation in keyframes.INTERPOLATIONS:
        one = keyframes.compile(_loop(interpolation))
        quats = np.concatenate([one.rotations[:-1], one.rotations[:3]])
        jolts[interpolation] = np.abs(np.diff(quats, n=2, axis=0)).max()
    assert jolts["spline"] < 0.25 * jolts["linear"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"interpolation": "cubic"}, "unknown interpolation .*linear, spline"),
        ({"axes": {"knee": "q", "hip": "yxz"}}, "axes of knee are 'q'"),
        ({"axes": {"knee": "y"}}, "unknown joint .*'hip'"),
        ({"axes": {"knee": "yx", "hip": "yxz"}}, "knee is 10: give 2 finite numbers"),
        ({"duration": None}, "must be later than its last pose"),
        ({"duration": 0.5}, "must be later than its last pose"),
        ({"loop": False}, "duration is for loops"),
        ({"rate": 0.0}, "rate 0.0 Hz"),
        ({"travel": (1.0,)}, "travel is .* give 3 finite numbers"),
        ({"keys": []}, "must begin with 0 and increase"),
        ({"keys": [Key(0.0, {}, (0, 0, 1)), Key(0.0, {})]}, "must begin with 0 and increase"),
        ({"keys": [Key(0.0, {}), Key(0.1, {})]}, "pose 0 has no root position"),
        ({"keys": [Key(0.0, {"knee": float("nan")}, (0, 0, 1))]}, "knee is nan"),
    ],
)
def test_refusals(changes: dict, said: str):
    with pytest.raises(UserError, match=said):
        keyframes.compile(dataclasses.replace(_loop("linear"), **changes))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate = 10", "rate = ", "cannot be read"),
        ("rate = 10", "speed = 10", "unknown entry .*'speed'"),
        ("time = 0.5", "", "pose 1 has no time"),
        ("right_knee = 80", "right_kne = 80", "unknown joint .*'right_kne'.*right_knee"),
        ("[joints]", "[joint]", "unknown entry"),
        ("right_knee = 80", "right_knee = [80, 0]", "give 1 finite number"),
    ],
)
def test_toml_refusals(tmp_path: Path, old: str, new: str, said: str):
    path = tmp_path / "bad.toml"
    path.write_text(TOML.replace(old, new))
    with pytest.raises(UserError, match=said) as error:
        clip.load(path)
    assert "\n" not in str(error.value) and "bad" in str(error.value)


JOGS = {"sparse_jog": 6, "sparse_high_knees": 4, "sparse_backward_jog": 5}


@pytest.mark.parametrize(("name", "poses"), JOGS.items())
def test_shipped_jogs_are_poor_but_sound(name: str, poses: int):
    """Key poses joined by straight lines that float and sink; yet no joint is misread."""
    one, who = clip.load(name), character.load("humanoid34")
    report = check.check(who, one)
    assert one.loop and f"{poses} key poses, linear in between" in one.notes
    assert report.ok and report.numbers["loop_gap"] == pytest.approx(0.0, abs=1e-3)
    assert -0.05 < report.numbers["floor_lowest"] < -0.01  # sinks
    assert 0.03 < report.numbers["floor_highest"] < 0.08  # floats
    assert not [f for f in report.findings if f.code in ("limits", "spike")]


@pytest.mark.parametrize("name", JOGS)
def test_shipped_jogs_bend_and_swing_the_human_way(name: str):
    """Shins swing back, forearms forward, each arm goes with the other side's leg."""
    one = clip.load(name)

    def forward(joint: str) -> np.ndarray:
        turns = Rotation.from_quat(one.rotations[:, one.joints.index(joint)], scalar_first=True)
        return -hinges.twist(turns, np.array([0.0, 1.0, 0.0]))

    for side, other in (("left", "right"), ("right", "left")):
        assert forward(f"{side}_knee").max() < 0.0 < forward(f"{side}_elbow").min()
        leg, arm, far_arm = (
            forward(f"{s}_{j}") for s, j in ((side, "hip"), (side, "shoulder"), (other, "shoulder"))
        )
        assert np.corrcoef(leg, far_arm)[0, 1] > 0.5 > -0.5 > np.corrcoef(leg, arm)[0, 1]


@pytest.mark.parametrize("name", ["sparse_jog", "sparse_high_knees"])
def test_shipped_jogs_are_the_same_on_both_sides(name: str):
    """The second half mirrors the first: sides exchanged, turns about x and z negated."""
    one = clip.load(name)
    frames = (len(one.times) - 1) // 2
    left, right = one.joints.index("left_hip"), one.joints.index("right_hip")
    assert one.rotations[frames, left] == pytest.approx(
        one.rotations[0, right] * [1, -1, 1, -1], abs=1e-9
    )
