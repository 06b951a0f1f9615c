# SPDX-License-Identifier: Apache-2.0
"""Faults of misread clips: tries the repair, accuses if it is clearly better.

Flipped hinges, left and right exchanged, wrong up axis, wrong length unit, wrong angle unit.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills.character import Character
from jaxskills.check import measures, repairs
from jaxskills.clip import roles
from jaxskills.clip.data import Clip
from jaxskills.retarget import Transfer, hinges, transfer
from jaxskills.retarget.mapping import Mapping, targets

SEVERITIES = ("info", "warning", "fault")

# A clip stands implausibly if its root is outside these, in standing heights, or its lowest point
# is on average this far from the floor (m). Real clips: crawl 0.36, get-up 0.29; backflip 0.14 m.
# Within that, other readings are still tried if it is further off than a clip without flight.
_HEIGHTS, _FLOOR, _NEAR_FLOOR = (0.12, 1.6), 0.25, 0.08
# Sidedness falls by 1.5 or more when a true exchange is undone and rises when a sound clip's sides
# are exchanged; the largest fall seen on a sound clip is 0.24 (a tight turn, legs only).
_SIDES_BETTER = 0.7
_BENT = 0.1  # rad, a knee that is clearly bent
_DEGREES = np.radians(360.0) * 1.05  # rad, no joint turns further
_TURNED = {"everything": "", "world": " (world axes only)", "positions": " (root positions only)"}
_STILL = np.radians(6.3)  # a full turn in rad, taken for degrees


@dataclasses.dataclass(frozen=True, eq=False)
class Finding:
    """One thing a person should know about a clip."""

    severity: str  # 'info', 'warning' or 'fault'
    code: str  # short and stable, such as 'flipped_hinge'
    text: str  # one sentence with the numbers and what to do
    repaired: Clip | None = None  # the clip with this fault undone, where that can be done


def find(character: Character, clip: Clip, mapping: Mapping) -> list[Finding]:
    """Returns the faults of a clip posed on a character, each with a repaired clip if possible.

    Later detectors work on the clip as repaired by the earlier ones, so one fault is named once.
    """
    found = _angle_units(clip)
    if found:
        return found + _world(character, clip, mapping)
    for detector in (_named_sides, _world, _flips, _sides):
        new = detector(character, clip, mapping)
        found += new
        if new and new[-1].repaired is not None:
            clip = new[-1].repaired
    return found


def _angle_units(clip: Clip) -> list[Finding]:
    """Degrees read as radians (angles beyond a full turn), or the reverse (nothing moves)."""
    peaks = dict(clip.file_angles)
    if not peaks:
        return []
    joint = max(peaks, key=lambda name: peaks[name])
    columns_only = set(peaks) != set(clip.joints)  # quaternions beside them have no unit
    if columns_only and peaks[joint] > _DEGREES:
        high = [name for name in peaks if peaks[name] > _DEGREES]
        text = (
            f"{', '.join(high)}: the file's angles reach {peaks[joint]:.4g} rad ({joint}), beyond a"
            " full turn: degrees were read as radians; write these columns in radians"
        )
        return [Finding("fault", "degrees_as_radians", text)]
    turns = 2.0 * np.arccos(np.clip(np.abs(clip.rotations[..., 0]), 0.0, 1.0))
    moves = float(np.degrees(turns.max())) > 20.0 if columns_only else True
    if moves and len(peaks) >= 3 and peaks[joint] < _STILL:
        text = (
            f"no angle in the file is larger than {np.degrees(peaks[joint]):.2g} degrees ({joint}):"
            " radians were taken for degrees; multiply the file's angles by 57.2958"
        )
        return [Finding("fault", "radians_as_degrees", text)]
    return []


def _world(character: Character, clip: Clip, mapping: Mapping) -> list[Finding]:
    """Wrong length unit or up axis: the root's height and the distance to the floor."""
    given = measures.world(character, clip, mapping)
    plausible = _HEIGHTS[0] < given.height < _HEIGHTS[1] and given.floor < _FLOOR
    if plausible and given.floor < _NEAR_FLOOR:
        return []
    enough = 0.35 * given.floor if plausible else max(0.12, min(0.2, 0.35 * given.floor))
    stands = f"the root is at {given.height:.3g} times the standing height of {character.name}"
    for guesses in (_one_cause(clip), () if plausible else _two_causes(clip)):
        better = []
        for causes, repaired in guesses:
            seen = measures.world(character, repaired, mapping)
            if seen.floor < enough and _HEIGHTS[0] < seen.height < _HEIGHTS[1]:
                cost = seen.floor / 0.1 - seen.upright
                if any(code == "up_axis" for code, _ in causes):
                    cost += max(measures.sidedness(character, repaired, mapping), 0.0)
                    cost += 0.5 * causes[-1][1].endswith("only)")  # half a conversion is rarer
                better.append((cost, len(better), causes, repaired, seen.height))
        if better:
            _, _, causes, repaired, height = min(better, key=lambda item: item[:2])
            said = f"{stands}, {height:.2f} when read the other way"
            return [Finding("fault", code, f"{text}: {said}", repaired) for code, text in causes]
    if not _HEIGHTS[0] < given.height < _HEIGHTS[1]:
        text = f"{stands}, and no common unit or up axis explains it: look at the root positions"
        return [Finding("fault", "root_height", text)]
    return []


def _one_cause(clip: Clip) -> Iterator[tuple[tuple[tuple[str, str], ...], Clip]]:
    """Yields (what could be wrong as pairs of code and text, the clip with it undone)."""
    for text, factor in repairs.UNITS.items():
        yield (("units", f"lengths are in {text}"),), repairs.rescale(clip, factor)
    for what, added in _TURNED.items():
        for text, axes in repairs.AXES.items():
            yield (("up_axis", text + added),), repairs.turn_axes(clip, axes, what)


def _two_causes(clip: Clip) -> Iterator[tuple[tuple[tuple[str, str], ...], Clip]]:
    for first, rescaled in list(_one_cause(clip))[: len(repairs.UNITS)]:
        for second, repaired in list(_one_cause(rescaled))[len(repairs.UNITS) :]:
            yield (*first, *second), repaired


def _flips(character: Character, clip: Clip, mapping: Mapping) -> list[Finding]:
    """Hinges often outside their range that would be inside with the sign flipped."""

    def accused(one: Clip) -> dict[str, str]:
        moved = transfer(character, one, mapping)
        return {**_hinge_flips(character, moved), **_ball_knees(character, one)}

    flipped = accused(clip)
    # With arms out at the zero pose, exchanged elbows bend backwards too: that is for `_sides`.
    if flipped and not accused(repairs.swap_sides(clip)):
        return []
    found = []
    for source, text in flipped.items():
        clip = repairs.flip(clip, source)
        found.append(Finding("fault", "flipped_hinge", text, clip))
    return found


def _hinge_flips(character: Character, moved: Transfer) -> dict[str, str]:
    sources = {to[0]: source for source, to in targets(moved.mapping).items() if len(to) == 1}
    accused = {}
    for limit in measures.limits(character, moved.qpos):
        if limit.axis or limit.joint not in sources:
            continue
        values = (limit.values + np.pi) % (2.0 * np.pi) - np.pi
        outside = float((limit.excess(values) > 0).mean())
        inside = float((limit.excess(-values) == 0).mean())
        if outside > 0.2 and inside > 0.95:
            accused[sources[limit.joint]] = (
                f"{_bends(sources[limit.joint])}: {outside:.0%} of the time outside the range"
                f" [{limit.low:.2f}, {limit.high:.2f}] rad of {limit.joint} (mean"
                f" {values.mean():+.2f}); with the sign flipped it is inside {inside:.0%} of the"
                " time: flip the axis"
            )
    return accused


def _ball_knees(character: Character, clip: Clip) -> dict[str, str]:
    """Knees without a range, told by the shin: it swings back about the axis to the left."""
    ball = {joint.name for joint in character.layout.joints if joint.kind == "ball"}
    mine = roles.of(tuple(joint.name for joint in character.layout.joints))
    accused = {}
    for role, source in roles.of(clip.joints).items():
        if not role.endswith("_knee") or mine.get(role) not in ball:
            continue
        local = clip.rotations[:, clip.joints.index(source)]
        bend = hinges.twist(Rotation.from_quat(local, scalar_first=True), np.array([0.0, 1.0, 0.0]))
        backwards = float((bend < -_BENT).mean())
        if backwards > 0.2 and (bend > _BENT).mean() < 0.05:
            accused[source] = (
                f"{_bends(source)}: {backwards:.0%} of the time its shin points forward (by"
                f" {np.degrees(-bend.min()):.0f} degrees at most): flip the axis"
            )
    return accused


def _bends(joint: str) -> str:
    role = next(iter(roles.groups([joint])), "")
    way = "bends backwards" if role.endswith(("_knee", "_elbow")) else "turns the wrong way"
    return f"{joint} {way}"


def _named_sides(character: Character, clip: Clip, mapping: Mapping) -> list[Finding]:
    """Joints called left that lie on the right of the clip's own skeleton."""
    if clip.skeleton is None:
        return []
    at = clip.skeleton.positions()
    named = roles.of(clip.joints)
    wrong = [
        limb
        for limb in ("hip", "shoulder")
        if f"left_{limb}" in named
        and f"right_{limb}" in named
        and at[clip.joints.index(named[f"left_{limb}"]), 1]
        < at[clip.joints.index(named[f"right_{limb}"]), 1] - 0.01
    ]
    if not wrong:
        return []
    limb = wrong[0]
    text = (
        f"left and right are exchanged: {named[f'left_{limb}']} lies to the right of"
        f" {named[f'right_{limb}']} at the clip's zero pose: exchange the names"
    )
    return [Finding("fault", "swapped_sides", text, repairs.rename_sides(clip))]


def _sides(character: Character, clip: Clip, mapping: Mapping) -> list[Finding]:
    """Limbs whose motion fits the other side of the body."""
    given = measures.sidedness(character, clip, mapping)
    options = []
    for parts in ("arms and legs", "arms", "legs"):
        repaired = repairs.swap_sides(clip, parts)
        options.append((measures.sidedness(character, repaired, mapping), parts, repaired))
    best, parts, repaired = min(options, key=lambda option: option[0])
    if given - best < _SIDES_BETTER:
        return []
    text = (
        f"left and right {parts} are exchanged: as read, limbs cross, turn inwards or run into the"
        f" body (score {given:.1f}, {best:.1f} when exchanged; lower is better): exchange them"
    )
    return [Finding("fault", "swapped_sides", text, repaired)]
