# SPDX-License-Identifier: Apache-2.0
"""Planted faults are named, sound clips are not accused, and the report says what was measured."""

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from jaxskills import character, check, clip, paths
from jaxskills.character import Character
from jaxskills.check import Report, measures, repairs
from jaxskills.clip.data import Clip, Skeleton
from jaxskills.errors import UserError
from jaxskills.retarget.mapping import Mapping, guess_mapping


@pytest.fixture(scope="module")
def humanoid() -> Character:
    return character.load("humanoid34")


@pytest.fixture(scope="module")
def jog() -> Clip:
    return clip.load("sparse_jog")


def faults(report: Report) -> list[str]:
    return [finding.code for finding in report.findings if finding.severity == "fault"]


def text(report: Report, code: str) -> str:
    return next(finding.text for finding in report.findings if finding.code == code)


def test_authored_jog_is_sound(humanoid: Character, jog: Clip):
    report = check.check(humanoid, jog)
    assert report.ok and faults(report) == []
    assert (report.frames, report.loop, len(report.matched)) == (23, True, 12)
    assert report.unmatched == () and report.undriven == () and report.lift == 0.0
    assert report.numbers["travel"] == pytest.approx(1.92)
    assert abs(report.numbers["travel_angle"]) < 10
    assert report.numbers["loop_gap"] < 0.1
    assert text(report, "heading").startswith("faces +x")
    assert "the way it faces" in text(report, "heading")
    for code in ("units", "up_axis", "swapped_sides", "flipped_hinge"):
        assert text(report, code)


PLANTED: dict[str, tuple[Callable[[Clip], Clip], list[str], str]] = {
    "right knee flipped": (
        lambda one: repairs.flip(one, "right_knee"),
        ["flipped_hinge"],
        "right_knee bends backwards: 100% of the time outside the range .* flip the axis",
    ),
    "left elbow flipped": (
        lambda one: repairs.flip(one, "left_elbow"),
        ["flipped_hinge"],
        "left_elbow bends backwards",
    ),
    "left and right": (repairs.swap_sides, ["swapped_sides"], "left and right .* exchange"),
    "centimetres": (lambda one: repairs.rescale(one, 100.0), ["units"], "centimetres"),
    "inches": (lambda one: repairs.rescale(one, 1 / 0.0254), ["units"], "inches"),
    "metres taken for millimetres": (
        lambda one: repairs.rescale(one, 1e-3),
        ["units"],
        "are in metres, but was read as millimetres",
    ),
    "y up": (lambda one: repairs.turn_axes(one, "x z -y"), ["up_axis"], "^y is up in the file"),
    "y up, z forward": (
        lambda one: repairs.turn_axes(one, "y z x"),
        ["up_axis"],
        "^y is up and z forward in the file",
    ),
    "y up, only the world": (
        lambda one: repairs.turn_axes(one, "x z -y", "world"),
        ["up_axis"],
        r"^y is up .*\(world axes only",
    ),
    "y up, only positions": (
        lambda one: repairs.turn_axes(one, "x z -y", "positions"),
        ["up_axis"],
        r"^y is up .*\(root positions only",
    ),
    "y up in centimetres": (
        lambda one: repairs.rescale(repairs.turn_axes(one, "x z -y"), 100.0),
        ["units", "up_axis"],
        "centimetres",
    ),
    "z up taken for y up": (
        lambda one: repairs.turn_axes(one, "x -z y"),
        ["up_axis"],
        "^z is up in the file, but was read as y up",
    ),
    "flipped and exchanged": (
        lambda one: repairs.swap_sides(repairs.flip(one, "left_knee")),
        ["flipped_hinge", "swapped_sides"],
        "right_knee bends backwards",
    ),
}


@pytest.mark.parametrize("fault", PLANTED)
def test_planted_faults_are_named_and_undone(humanoid: Character, jog: Clip, fault: str):
    plant, codes, said = PLANTED[fault]
    report = check.check(humanoid, plant(jog))
    assert faults(report) == codes and not report.ok
    first = next(finding for finding in report.findings if finding.severity == "fault")
    assert re.search(said, first.text), first.text
    # The last repair undoes all of it.
    repaired = [f.repaired for f in report.findings if f.severity == "fault"][-1]
    assert repaired is not None
    assert repaired.root_pos == pytest.approx(jog.root_pos, abs=1e-9)
    same = np.abs(np.sum(repaired.rotations * jog.rotations, axis=-1))
    assert same == pytest.approx(np.ones_like(same))


def deepmimic_file(path: Path, one: Clip, hinge_factor: float = 1.0) -> Path:
    """Writes a clip in the DeepMimic format (y up), its single angles times `hinge_factor`."""

    def y_up(array: np.ndarray) -> list[float]:
        x, y, z = array[-3:]
        return [*array[:-3].tolist(), float(x), float(z), float(-y)]

    frames = []
    for index in range(len(one.times)):
        row = [1 / 30, *y_up(one.root_pos[index]), *y_up(one.root_rot[index])]
        for joint, name in enumerate(one.joints):
            quat = one.rotations[index, joint]
            angle = -2.0 * np.arctan2(quat[2], quat[0]) * hinge_factor
            hinge = name.endswith(("knee", "elbow"))
            row += [float(angle)] if hinge else y_up(quat)
        frames.append(row)
    path.write_text(json.dumps({"Loop": "wrap", "Frames": frames}))
    return path


def test_angle_units(humanoid: Character, jog: Clip, tmp_path: Path):
    sound = clip.load(deepmimic_file(tmp_path / "a.txt", jog))
    assert sound.rotations == pytest.approx(jog.rotations)
    assert faults(check.check(humanoid, sound)) == []
    degrees = clip.load(deepmimic_file(tmp_path / "b.txt", jog, np.degrees(1.0)))
    report = check.check(humanoid, degrees)
    assert faults(report) == ["degrees_as_radians"]
    assert "right_knee" in text(report, "degrees_as_radians")
    twice = clip.load(deepmimic_file(tmp_path / "c.txt", jog, np.radians(1.0)))
    assert faults(check.check(humanoid, twice)) == ["radians_as_degrees"]


def test_sides_named_wrongly_in_the_skeleton(humanoid: Character, jog: Clip):
    """The motion of each joint is right, but those on the left are called right."""
    assert jog.skeleton is not None
    renamed = repairs.rename_sides(jog)
    report = check.check(humanoid, renamed)
    assert "left_hip lies to the right of right_hip" in text(report, "swapped_sides")
    assert faults(report) == ["swapped_sides"]


def test_ball_knees_bend_one_way(jog: Clip):
    human = character.load("human21")
    assert faults(check.check(human, jog)) == []
    report = check.check(human, repairs.flip(jog, "left_knee"))
    assert faults(report) == ["flipped_hinge"]
    assert "left_knee bends backwards" in text(report, "flipped_hinge")


def test_numbers_of_a_poor_clip(humanoid: Character, jog: Clip):
    """Raised by 20 cm, a spike, a jump of the root, an open seam, sideways travel."""
    root_pos = jog.root_pos[:, [1, 0, 2]] + [0, 0, 0.2]
    root_pos[12:, 0] += 1.0
    rotations = jog.rotations.copy()
    neck = jog.joints.index("neck")
    rotations[10, neck] = [0.0, 0.0, 0.0, 1.0]
    rotations[-1, neck] = [0.0, 1.0, 0.0, 0.0]
    poor = dataclasses.replace(jog, root_pos=root_pos, rotations=rotations)
    report = check.check(humanoid, poor)
    warned = [finding.code for finding in report.findings if finding.severity == "warning"]
    assert {"floats", "spike", "root_jump", "loop_gap"} <= set(warned)
    assert faults(report) == []
    assert text(report, "spike").startswith("neck turns at")
    assert report.numbers["floor_lowest"] == pytest.approx(0.188, abs=0.005)
    assert "Mapping(lift=-0.187)" in text(report, "floats")
    assert report.numbers["floor_above_share"] == 1.0
    assert "frame 11: it jumps" in text(report, "root_jump")
    assert report.numbers["loop_gap"] == pytest.approx(180, abs=10)
    assert "sideways, to its left" in text(report, "heading")
    lowered = check.check(
        humanoid, jog, dataclasses.replace(guess_mapping(humanoid, jog), lift=-0.1)
    )
    assert lowered.numbers["floor_below_share"] > 0.9
    assert "Mapping(lift=" in text(lowered, "in_floor")


def test_limits_are_timed(humanoid: Character, jog: Clip):
    rotations = jog.rotations.copy()
    knee = jog.joints.index("left_knee")
    rotations[:9, knee] = [np.cos(0.35), 0, -np.sin(0.35), 0]  # 0.7 rad the wrong way, 9 of 23
    report = check.check(humanoid, dataclasses.replace(jog, rotations=rotations))
    assert faults(report) == []
    assert "left_knee is outside its range [-3.14, 0.00] rad 39% of the time" in text(
        report, "limits"
    )
    assert "by up to 0.70 rad" in text(report, "limits")


def test_joints_without_counterpart(humanoid: Character, jog: Clip):
    renamed = dataclasses.replace(
        jog, joints=tuple(name.replace("neck", "antenna") for name in jog.joints)
    )
    report = check.check(humanoid, renamed)
    assert report.unmatched == ("antenna",) and report.undriven == ("neck",)
    with pytest.raises(UserError, match="unknown joint"):
        check.check(humanoid, jog, Mapping({"antenna": "neck"}))


def test_report_as_text_and_as_plain_types(humanoid: Character, jog: Clip):
    report = check.check(humanoid, repairs.flip(jog, "right_knee"))
    plain = json.loads(json.dumps(report.as_dict()))
    assert plain["ok"] is False and plain["clip"] == "sparse_jog" and plain["frames"] == 23
    assert plain["findings"][0]["severity"] == "fault"
    assert set(plain["findings"][0]) == {"severity", "code", "text"}
    lines = check.format_report(report).splitlines()
    assert lines[0] == "sparse_jog on humanoid34: 23 frames, 30.56 Hz, 0.720 s, loops"
    assert lines[2].startswith("fault    flipped_hinge: right_knee bends backwards")
    assert lines[-1].startswith("1 faults, ")


def test_repairs_name_what_they_do_not_know(jog: Clip):
    for call in (
        lambda: repairs.flip(jog, "tail"),
        lambda: repairs.swap_sides(jog, "ears"),
        lambda: repairs.turn_axes(jog, "x -z y", "nothing"),
    ):
        with pytest.raises(UserError, match="choose one of"):
            call()


def test_measures_of_standing_and_swapping(humanoid: Character, jog: Clip):
    assert measures.standing_height(humanoid) == pytest.approx(0.8814, abs=1e-4)
    mapping = guess_mapping(humanoid, jog)
    swapped = repairs.swap_sides(jog)
    given = measures.sidedness(humanoid, jog, mapping)
    assert measures.sidedness(humanoid, swapped, mapping) > given + 1.0
    assert measures.sidedness(humanoid, repairs.swap_sides(swapped), mapping) == given


def test_skeleton_of_swapped_bvh_names():
    """Exchanging names keeps positions: a clip with right names is left alone."""
    skeleton = Skeleton((-1, -1), np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]))
    quats = np.tile([1.0, 0, 0, 0], (2, 2, 1))
    one = Clip(
        "x",
        np.arange(2.0),
        ("thigh.L", "thigh.R"),
        np.zeros((2, 3)),
        quats[:, 0],
        quats,
        False,
        skeleton=skeleton,
    )
    assert repairs.rename_sides(one).joints == ("thigh.R", "thigh.L")


REAL = ("walk", "run", "jump", "cartwheel", "backflip", "roll", "dance_a", "spin", "spinkick")
REAL += ("crawl", "punch", "kick", "getup_facedown", "getup_faceup", "walker/turn_right0")


@pytest.mark.parametrize("name", REAL)
def test_sound_clips_are_not_accused(humanoid: Character, deepmimic: Path, name: str):
    assert deepmimic in paths.deepmimic_dirs()
    assert faults(check.check(humanoid, clip.load(name))) == []


@pytest.mark.parametrize("name", ["walk", "crawl"])
def test_real_clips_with_planted_faults(humanoid: Character, deepmimic: Path, name: str):
    sound = clip.load(name)
    for fault in ("right knee flipped", "left and right", "centimetres", "z up taken for y up"):
        plant, codes, _ = PLANTED[fault]
        assert faults(check.check(humanoid, plant(sound))) == codes, fault


def test_turning_that_changes_in_the_air_is_named(humanoid: Character, deepmimic: Path):
    flip = check.check(humanoid, clip.load("backflip"))
    assert re.search(r"up to 7\.\d rad/s off .* at 6\d% of the clip", text(flip, "flight"))
    jump = check.check(humanoid, clip.load("jump"))
    assert "flight" not in [finding.code for finding in jump.findings]
    assert 0.5 < jump.numbers["flight_turning"] < 2.0
