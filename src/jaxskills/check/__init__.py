# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a clip before anything is trained on it, in sentences a person can act on."""

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxskills import flight, motion, retarget
from jaxskills.character import Character
from jaxskills.check import faults, measures
from jaxskills.check.faults import SEVERITIES, Finding
from jaxskills.clip.data import Clip
from jaxskills.retarget import posed
from jaxskills.retarget.mapping import Mapping, guess_mapping, targets

__all__ = ["SEVERITIES", "Finding", "Report", "check", "format_report"]

_CLEAR = 0.03  # m above or below the floor that nobody sees
_FAST = 25.0  # rad/s, joints of real clips spike to 30 in noise, people reach about 20
_TRAVEL = 0.3  # m, less is standing
_LOOP_GAP = 45.0  # degrees
_TUMBLE = 4.0  # rad/s that the body's turning in flight may be off; the clips of SB: backflip 7, 2


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """The outcome of `check`. Shares are between 0 and 1."""

    clip: str
    character: str
    frames: int
    rate: float  # Hz
    duration: float  # s
    loop: bool
    matched: dict[str, str]  # clip joint -> character joint(s)
    unmatched: tuple[str, ...]  # clip joints that drive nothing
    undriven: tuple[str, ...]  # character joints that nothing drives
    scale: float  # of the root positions
    lift: float  # m added to the root's height
    numbers: dict[str, float]  # what was measured, by name
    findings: tuple[Finding, ...]  # worst first

    @property
    def ok(self) -> bool:
        """True if nothing is a fault."""
        return all(finding.severity != "fault" for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Returns plain types only, for JSON."""
        fields = [f.name for f in dataclasses.fields(self) if f.name != "findings"]
        keep = ("severity", "code", "text")
        return {
            **{name: getattr(self, name) for name in fields},
            "ok": self.ok,
            "findings": [{key: getattr(item, key) for key in keep} for item in self.findings],
        }


def check(character: Character, clip: Clip, mapping: Mapping | None = None) -> Report:
    """Returns what a person should know before training on `clip`.

    The clip is posed on the character; named faults (`faults`) are found by trying their repair.

    Args:
      character: what will do the motion.
      clip: the motion.
      mapping: which joint drives which; guessed if None.

    Raises:
      UserError: the mapping names joints that do not exist.
    """
    mapping = guess_mapping(character, clip) if mapping is None else mapping
    moved = retarget.transfer(character, clip, mapping)
    view = posed.look(character.model, moved.qpos)
    numbers: dict[str, float] = {}
    driven = {name for names in targets(mapping).values() for name in names}
    movable = [joint.name for joint in character.layout.joints if joint.kind != "free"]
    unmatched = tuple(name for name in clip.joints if name not in mapping.joints)
    undriven = tuple(name for name in movable if name not in driven)
    found = faults.find(character, clip, mapping)
    found += _matching(character, mapping, unmatched, undriven, moved)
    found += _timing(clip, numbers) + _loop(clip, numbers) + _floor(view, moved.lift, numbers)
    found += _speeds(clip, numbers) + _limits(character, moved, numbers)
    found += _flight(character, clip, moved, numbers)
    found += _heading(clip, moved, numbers) + _sound(character, clip, mapping, found)
    found += [Finding("info", "loader", note) for note in clip.notes]
    return Report(
        clip=clip.name,
        character=character.name,
        frames=len(clip.times),
        rate=clip.rate,
        duration=clip.duration,
        loop=clip.loop,
        matched={source: ", ".join(names) for source, names in targets(mapping).items()},
        unmatched=unmatched,
        undriven=undriven,
        scale=moved.scale,
        lift=moved.lift,
        numbers=numbers,
        findings=tuple(sorted(found, key=lambda item: -SEVERITIES.index(item.severity))),
    )


def format_report(report: Report) -> str:
    """Returns the report as plain text: a header, then one line per finding, worst first."""
    counts = {s: sum(f.severity == s for f in report.findings) for s in SEVERITIES}
    joined = f"{len(report.matched)} joints matched"
    if report.unmatched:
        joined += f", {len(report.unmatched)} of the clip unused"
    if report.undriven:
        joined += f", {len(report.undriven)} of the character undriven"
    moved = f"root positions scaled by {report.scale:.3g}, lifted by {100 * report.lift:.1f} cm"
    lines = [
        f"{report.clip} on {report.character}: {report.frames} frames, {report.rate:.4g} Hz,"
        f" {report.duration:.3f} s, {'loops' if report.loop else 'does not loop'}",
        f"{joined}; {moved}",
        *(f"{item.severity:<7}  {item.code}: {item.text}" for item in report.findings),
        f"{counts['fault']} faults, {counts['warning']} warnings",
    ]
    return "\n".join(lines)


def _matching(
    character: Character,
    mapping: Mapping,
    unmatched: tuple[str, ...],
    undriven: tuple[str, ...],
    moved: retarget.Transfer,
) -> list[Finding]:
    found = []
    surprising = [name for name in unmatched if name not in mapping.ignored]
    if surprising:
        text = f"clip joints without a counterpart: {', '.join(surprising)}"
        found.append(Finding("warning", "unmatched_joints", text))
    if undriven:
        share = len(undriven) / (len(undriven) + len(targets(mapping)))
        text = f"joints of {character.name} that stay at their zero pose: {', '.join(undriven)}"
        severity = "warning" if share > 0.5 else "info"
        found.append(Finding(severity, "undriven_joints", text))
    for joint, lost in moved.lost.items():
        if np.degrees(lost.max()) > 10.0:
            text = (
                f"{joint} turns up to {np.degrees(lost.max()):.0f} degrees off what its hinges can"
                f" do (mean {np.degrees(lost.mean()):.0f}); joints below make up for what they can"
            )
            severity = "warning" if np.degrees(lost.mean()) > 15.0 else "info"
            found.append(Finding(severity, "lost_rotation", text))
    return found


def _timing(clip: Clip, numbers: dict[str, float]) -> list[Finding]:
    found = []
    numbers |= {"rate": clip.rate, "duration": clip.duration}
    if not 10.0 <= clip.rate <= 250.0:
        text = f"{clip.rate:.3g} frames a second is unusual: 24 to 120 is common"
        found.append(Finding("warning", "rate", text))
    if not 0.2 <= clip.duration <= 60.0:
        text = f"the clip lasts {clip.duration:.3g} s: a skill is a motion of about 0.5 to 20 s"
        found.append(Finding("warning", "duration", text))
    return found


def _loop(clip: Clip, numbers: dict[str, float]) -> list[Finding]:
    ends = clip.rotations[[0, -1]]
    cosines = np.abs(np.sum(ends[0] * ends[1], axis=-1))
    gaps = np.degrees(2.0 * np.arccos(np.clip(cosines, 0.0, 1.0)))
    worst = int(np.argmax(gaps))
    numbers["loop_gap"] = float(gaps[worst])
    text = f"the last pose is {gaps[worst]:.0f} degrees from the first at {clip.joints[worst]}"
    if not clip.loop:
        return [Finding("info", "loop_gap", f"does not loop; {text}")]
    if gaps[worst] > _LOOP_GAP:
        return [Finding("warning", "loop_gap", f"loops, but {text}: the seam will be visible")]
    return [Finding("info", "loop_gap", f"loops; {text}")]


def _floor(view: posed.Look, lift: float, numbers: dict[str, float]) -> list[Finding]:
    lowest = view.lowest
    below, above = float((lowest < -_CLEAR).mean()), float((lowest > _CLEAR).mean())
    numbers |= {
        "floor_lowest": float(lowest.min()),
        "floor_highest": float(lowest.max()),
        "floor_below_share": below,
        "floor_above_share": above,
    }
    frame = int(np.argmin(lowest))
    if lowest.min() > _CLEAR:
        better = lift - float(lowest.min())
        text = f"never touches the floor, {lowest.min():.2f} m above: Mapping(lift={better:.3f})"
        return [Finding("warning", "floats", text)]
    if below > 0.5:
        middle = float(np.median(lowest))
        text = (
            f"more than 3 cm in the floor {below:.0%} of the time, {-100 * middle:.0f} cm mostly:"
            f" Mapping(lift={lift - middle:.3f})"
        )
        return [Finding("warning", "in_floor", text)]
    if lowest.min() < -0.05 or below > 0.1:
        text = (
            f"sinks {-100 * lowest.min():.0f} cm into the floor at frame {frame}, more than 3 cm in"
            f" {below:.0%} of the frames"
        )
        return [Finding("warning", "in_floor", text)]
    text = (
        f"lowest point {100 * lowest.min():+.1f} to {100 * lowest.max():+.1f} cm from the floor;"
        f" in the air {above:.0%} of the time"
    )
    return [Finding("info", "floor", text)]


def _speeds(clip: Clip, numbers: dict[str, float]) -> list[Finding]:
    quats = np.concatenate([clip.root_rot[:, None], clip.rotations], axis=1)
    cosines = np.abs(np.sum(quats[1:] * quats[:-1], axis=-1))
    steps = np.diff(clip.times)[:, None]
    speeds = 2.0 * np.arccos(np.clip(cosines, 0.0, 1.0)) / steps
    frame, joint = np.unravel_index(int(np.argmax(speeds)), speeds.shape)
    name = ("root", *clip.joints)[joint]
    numbers["joint_speed"] = float(speeds[frame, joint])
    root = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=1) / steps[:, 0]
    numbers["root_speed"] = float(root.max())
    found = []
    if speeds[frame, joint] > _FAST:
        text = (
            f"{name} turns at {speeds[frame, joint]:.0f} rad/s at frame {frame}"
            f" ({clip.times[frame]:.2f} s): smooth or cut it, no servo follows that"
        )
        found.append(Finding("warning", "spike", text))
    if root.max() > max(10.0, 5.0 * float(np.median(root))) and root.max() > 10.0:
        text = f"the root moves at {root.max():.3g} m/s at frame {int(np.argmax(root))}: it jumps"
        found.append(Finding("warning", "root_jump", text))
    return found


def _flight(
    character: Character, clip: Clip, moved: retarget.Transfer, numbers: dict[str, float]
) -> list[Finding]:
    """Angular momentum that changes in the air, told by the turning that is too much or lacking."""
    plain = motion.from_qpos(character.model, moved.qpos, clip.times, clip.loop)
    change = (flight.ballistic(character, plain).qvel - plain.qvel)[:, 3:6]
    off = np.linalg.norm(np.asarray(change), axis=1)
    numbers["flight_turning"] = float(off.max())
    if off.max() < _TUMBLE:
        return []
    share = float(off.argmax()) / (len(off) - 1)
    text = (
        f"in the air the body's turning is up to {off.max():.1f} rad/s off what keeps its angular"
        f" momentum, at {share:.0%} of the clip: learn it with --motion.ballistic"
    )
    return [Finding("warning", "flight", text)]


def _limits(
    character: Character, moved: retarget.Transfer, numbers: dict[str, float]
) -> list[Finding]:
    found, worst = [], 0.0
    for limit in measures.limits(character, moved.qpos):
        excess = limit.excess()
        share = float((excess > 0).mean())
        worst = max(worst, share)
        if share > 0.05:
            text = (
                f"{limit.joint}{' ' + limit.axis if limit.axis else ''} is outside its range"
                f" [{limit.low:.2f}, {limit.high:.2f}] rad {share:.0%} of the time, by up to"
                f" {excess.max():.2f} rad"
            )
            severity = "warning" if not limit.axis and excess.max() > 0.35 else "info"
            found.append(Finding(severity, "limits", text))
    numbers["limits_share"] = worst
    return found


def _heading(clip: Clip, moved: retarget.Transfer, numbers: dict[str, float]) -> list[Finding]:
    root = Rotation.from_quat(clip.root_rot, scalar_first=True)
    forward, up = root.apply([1.0, 0.0, 0.0]), root.apply([0.0, 0.0, 1.0])
    standing = up[:, 2] > 0.5
    way = moved.qpos[-1, :2] - moved.qpos[0, :2]
    far = float(np.linalg.norm(way))
    numbers["travel"] = far
    goes = f"travels {far:.2f} m" + (f" towards {_compass(way)}" if far > _TRAVEL else "")
    if not standing.any():
        return [Finding("info", "heading", f"never stands upright; {goes}")]
    faces = forward[standing, :2].mean(axis=0)
    text = f"faces {_compass(faces)}; {goes}"
    if far > _TRAVEL:
        angle = np.degrees(np.arctan2(faces[0] * way[1] - faces[1] * way[0], faces @ way))
        numbers["travel_angle"] = float(angle)
        text += ", " + _relative(float(angle))
    return [Finding("info", "heading", text)]


def _compass(way: np.ndarray) -> str:
    axis = int(np.argmax(np.abs(way)))
    angle = np.degrees(np.arctan2(way[1], way[0]))
    return f"{'+' if way[axis] > 0 else '-'}{'xy'[axis]} ({angle:.0f} degrees)"


def _relative(angle: float) -> str:
    if abs(angle) < 45.0:
        return "the way it faces"
    if abs(angle) > 135.0:
        return "backwards: against the way it faces (right for a backflip, wrong for a walk)"
    side = "left" if angle > 0 else "right"
    return f"sideways, to its {side} (right for a cartwheel, wrong for a walk)"


def _sound(
    character: Character, clip: Clip, mapping: Mapping, found: list[Finding]
) -> list[Finding]:
    """Says what was looked for and not found."""
    codes = {finding.code for finding in found if finding.severity == "fault"}
    height = measures.world(character, clip, mapping).height
    said = {
        "units": f"metres (root at {height:.2f} times the standing height)",
        "up_axis": "z is up",
        "swapped_sides": "left and right look right",
        "flipped_hinge": "no joint bends the wrong way",
    }
    if codes & {"root_height", "degrees_as_radians", "radians_as_degrees"}:
        return []
    return [Finding("info", code, text) for code, text in said.items() if code not in codes]
