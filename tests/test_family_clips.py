# SPDX-License-Identifier: Apache-2.0
"""The shipped clips for families of skills: they obey contacts, gravity and the things they use."""

import dataclasses
import functools

import mujoco
import numpy as np
import pytest

from jaxskills import character, check, clip, retarget

G, RATE = 9.8, 30.0
CLOSE = 0.01  # m
SIDES = ("left", "right")
_CORNERS = np.array(
    [(x, y, -0.05) for x in (-0.0435, 0.1335) for y in (-0.045, 0.045)]
)  # heel first

# The things that the clips are made for, as in the heads of their files: m, s.
FACE, PUSHED, HANDS_HIGH = 0.65, 1.2, 1.13
BAR = np.array([0.56, 2.3])  # x, z
WALL_X, WALL_HIGH = (1.3, 1.5), 0.9


SOLE, TOES = (0, 1, 2, 3), (2, 3)  # corners of a foot


@dataclasses.dataclass(frozen=True)
class Stand:
    """A foot that stands from `start` to `end`, wholly or on its toes."""

    side: str
    start: float  # s
    end: float  # s
    corners: tuple[int, ...] = SOLE


@dataclasses.dataclass(frozen=True)
class Case:
    """What holds of one clip."""

    name: str
    seconds: float
    stands: tuple[Stand, ...]
    flights: tuple[tuple[float, float], ...] = ()  # s
    travel: tuple[float, float] = (0.0, 0.0)  # m
    turn: float = 0.0  # degrees, from the first pose to the last


def _both(start: float, end: float, corners: tuple[int, ...] = SOLE) -> tuple[Stand, ...]:
    return tuple(Stand(side, start, end, corners) for side in SIDES)


DODGE = Case("dodge", 1.8, _both(0.0, 1.8))
PIVOT = Case(
    "pivot",
    1.3,
    (
        Stand("left", 0.0, 0.133),
        Stand("left", 0.4, 1.3),
        Stand("right", 0.0, 0.367),
        Stand("right", 0.4, 0.5, TOES),
        Stand("right", 0.833, 1.3),
    ),
    travel=(0.0, 0.27),
    turn=-77.0,
)
PUSH = Case(
    "push",
    4.2,
    (
        *(Stand("right", *at) for at in ((0.467, 0.833), (1.3, 1.833), (2.3, 2.833), (3.267, 4.2))),
        *(Stand("left", *at) for at in ((0.0, 1.333), (1.8, 2.333), (2.8, 3.367), (3.767, 4.2))),
        *(Stand("right", *at, TOES) for at in ((0.867, 0.967), (1.867, 1.967), (2.867, 2.967))),
        *(Stand("left", *at, TOES) for at in ((1.367, 1.467), (2.367, 2.467))),
    ),
    travel=(1.17, 0.0),
)
SWING = Case(
    "swing",
    2.6,
    (*_both(0.0, 0.5), *_both(0.533, 0.633, TOES), *_both(1.833, 2.6)),
    flights=((0.633, 0.9), (1.467, 1.833)),
    travel=(1.22, 0.0),
)
WALL_JUMP = Case(
    "wall_jump",
    2.5,
    (
        Stand("left", 0.567, 0.7),
        Stand("right", 0.933, 1.1),
        *_both(1.0, 1.1),
        *_both(1.133, 1.2, TOES),
        *_both(1.867, 2.5),
    ),
    flights=((1.2, 1.3), (1.533, 1.867)),
    travel=(2.014, 0.0),
)
CASES = (DODGE, PIVOT, PUSH, SWING, WALL_JUMP)
each = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """A clip posed on the humanoid with MuJoCo on the host; sides are left, right."""

    qpos: np.ndarray  # [F, nq]
    com: np.ndarray  # [F, 3] m
    turning: np.ndarray  # [F, 3] angular momentum about the CoM, kg m^2/s
    soles: np.ndarray  # [F, 2, 4, 3] m, corners: two of the heel, two of the toes
    wrists: np.ndarray  # [F, 2, 3] m


@functools.cache
def see(name: str) -> Seen:
    who = character.load("humanoid34")
    model, data = who.model, mujoco.MjData(who.model)
    qpos = retarget.retarget(who, clip.load(name))
    last, rows = len(qpos) - 1, []
    for i, pose in enumerate(qpos):
        a, b = max(i - 1, 0), min(i + 1, last)
        mujoco.mj_differentiatePos(model, data.qvel, (b - a) / RATE, qpos[a], qpos[b])
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        ankles = [data.body(f"{side}_ankle") for side in SIDES]
        soles = [body.xpos + _CORNERS @ body.xmat.reshape(3, 3).T for body in ankles]
        wrists = [data.body(f"{side}_wrist").xpos.copy() for side in SIDES]
        rows.append((data.subtree_com[1].copy(), data.subtree_angmom[1].copy(), soles, wrists))
    return Seen(qpos, *(np.array(column) for column in zip(*rows, strict=True)))


def frames(start: float, end: float) -> np.ndarray:
    return np.arange(round(start * RATE), round(end * RATE) + 1)


@each
def test_sound(case: Case):
    one = clip.load(case.name)
    report = check.check(character.load("humanoid34"), one)
    assert one.duration == pytest.approx(case.seconds) and one.rate == pytest.approx(RATE)
    assert one.loop == (case.name == "dodge")
    assert not [item for item in report.findings if item.severity != "info"]
    assert report.numbers["limits_share"] == 0.0
    assert report.numbers["joint_speed"] < 12.0


@each
def test_feet_stand_on_the_floor_and_do_not_slide(case: Case):
    soles = see(case.name).soles
    assert soles[..., 2].min() > -CLOSE
    for stand in case.stands:
        on = soles[frames(stand.start, stand.end), SIDES.index(stand.side)][:, list(stand.corners)]
        assert np.abs(on[..., 2]).max() < CLOSE, stand
        assert np.ptp(on[..., :2], axis=0).max() < CLOSE, stand
    # A corner that is on the floor stays where it is, in every frame.
    low = (soles[1:, ..., 2] < 0.006) & (soles[:-1, ..., 2] < 0.006)
    steps = np.linalg.norm(np.diff(soles[..., :2], axis=0), axis=-1)
    assert steps[low].max() < CLOSE


@each
def test_ends_at_rest_in_the_pose_it_began_with(case: Case):
    """Only moved and turned, and with the centre of mass over the feet."""
    seen = see(case.name)
    first, last = seen.qpos[[0, -1]]
    assert last[7:] == pytest.approx(first[7:], abs=0.02)
    assert last[:2] - first[:2] == pytest.approx(case.travel, abs=0.01)
    back, turned = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, first[3:7])
    mujoco.mju_mulQuat(turned, last[3:7], back)
    half = np.radians(case.turn) / 2
    assert turned * np.sign(turned[0]) == pytest.approx(
        [np.cos(half), 0, 0, np.sin(half)], abs=0.01
    )
    for end in (slice(0, 2), slice(-2, None)):
        assert np.abs(np.diff(seen.qpos[end, :3], axis=0)).max() * RATE < 0.15
    for end in (0, -1):
        corners = seen.soles[end].reshape(-1, 3)[:, :2]
        inside = (corners.min(0) + 0.02 < seen.com[end, :2]) & (
            seen.com[end, :2] < corners.max(0) - 0.02
        )
        assert inside.all()


@each
def test_forces_of_the_stance_could_carry_it(case: Case):
    """The centre of mass is never pulled down, and thrown up only in landings."""
    com = see(case.name).com
    up = np.diff(com[:, 2], n=2) * RATE**2
    assert up.min() > -1.2 * G
    assert up.max() < {"swing": 5.0, "wall_jump": 6.0}.get(case.name, 1.0) * G  # landings


@pytest.mark.parametrize("case", [SWING, WALL_JUMP], ids=lambda case: case.name)
def test_flights_are_ballistic(case: Case):
    seen = see(case.name)
    for start, end in case.flights:
        rows = frames(start, end)
        times = (rows - rows[0]) / RATE
        fitted = [2 * np.polyfit(times, seen.com[rows, axis], 2)[0] for axis in range(3)]
        assert fitted == pytest.approx([0.0, 0.0, -G], abs=0.3)
        inner = seen.turning[rows[1:-1]]  # kept in the air, up to what key poses leave over
        assert np.ptp(inner, axis=0).max() < 1.5
        assert (seen.soles[rows[2:-2], ..., 2] > 0.01).all()


def test_dodge_ducks_to_the_left_over_the_feet():
    seen = see("dodge")
    who = character.load("humanoid34")
    model, data = who.model, mujoco.MjData(who.model)
    head = []
    for pose in seen.qpos:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        head.append(data.geom("neck").xpos.copy())
    moved = np.array(head) - head[0]
    lowest = int(moved[:, 2].argmin())
    assert moved[lowest, 2] < -0.2 and moved[lowest, 1] > 0.2
    assert 0.4 < lowest / RATE < 0.8
    corners = seen.soles[0].reshape(-1, 3)[:, :2]
    assert (seen.com[:, :2] > corners.min(0)).all() and (seen.com[:, :2] < corners.max(0)).all()
    assert np.ptp(seen.com[:, 1]) > 0.05  # the weight goes over and comes back


def test_pivot_turns_on_the_spot():
    assert np.ptp(see("pivot").com[:, :2], axis=0).max() < 0.35


def test_push_keeps_the_hands_in_a_plane_that_moves_on():
    wrists = see("push").wrists[frames(0.633, 3.4)]
    assert np.abs(wrists[:, 0, 0] - wrists[:, 1, 0]).max() < CLOSE
    assert np.abs(wrists[..., 2] - HANDS_HIGH).max() < CLOSE
    plane = wrists[..., 0].mean(1)
    assert plane[0] == pytest.approx(FACE - 0.04, abs=CLOSE)
    assert plane[-1] - plane[0] == pytest.approx(PUSHED, abs=CLOSE)
    assert np.diff(plane).min() > -0.003  # never back
    assert np.diff(plane).max() * RATE < 0.65


def test_swing_hangs_from_the_bar_like_a_pendulum():
    seen, rows = see("swing"), frames(0.9, 1.467)
    assert np.abs(seen.wrists[rows][..., [0, 2]] - BAR).max() < CLOSE
    along = seen.com[rows][:, [0, 2]] - BAR
    assert np.ptp(np.linalg.norm(along, axis=1)) < 0.05
    angle = np.degrees(np.arctan2(along[:, 0], -along[:, 1]))
    assert angle[0] < -5.0 and angle[-1] > 15.0 and (np.diff(angle) > 0).all()
    speed = np.gradient(seen.com, 1 / RATE, axis=0)[rows]
    energy = G * seen.com[rows, 2] + 0.5 * np.sum(speed**2, axis=1)  # J/kg
    assert np.ptp(energy) < 0.6


def test_wall_jump_props_both_hands_on_the_wall():
    wrists = see("wall_jump").wrists[frames(1.3, 1.533)]
    assert np.abs(wrists[..., 2] - WALL_HIGH - 0.04).max() < CLOSE  # a hand is 4 cm thick
    assert (wrists[..., 0] > WALL_X[0]).all() and (wrists[..., 0] < WALL_X[1]).all()
    assert np.ptp(wrists, axis=0).max() < CLOSE


def _distances(name: str, size: list[float], at: np.ndarray, spared: str) -> np.ndarray:
    """Least distance [F] in m between a box at `at [F, 3]` and all but the named parts."""
    who = character.load("humanoid34")
    spec = mujoco.MjSpec.from_file(who.source)
    kind = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(name="thing", type=kind, size=size, pos=[9.0, 9.0, 9.0])
    model = spec.compile()
    data, thing = mujoco.MjData(model), model.geom("thing").id
    bodies = [
        geom
        for geom in range(model.ngeom)
        if model.geom_bodyid[geom] > 0
        and not any(word in model.geom(geom).name for word in ("look", *spared.split()))
    ]
    found = []
    for pose, place in zip(see(name).qpos, at, strict=True):
        model.geom_pos[thing] = place
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        found.append(min(mujoco.mj_geomDistance(model, data, g, thing, 1.0, None) for g in bodies))
    return np.array(found)


def test_nothing_goes_through_wall_bar_or_box():
    count = len(see("wall_jump").qpos)
    middle = [sum(WALL_X) / 2, 0.0, WALL_HIGH / 2]
    size = [(WALL_X[1] - WALL_X[0]) / 2, 2.0, WALL_HIGH / 2]
    assert _distances("wall_jump", size, np.tile(middle, (count, 1)), "wrist").min() > 0.0
    hands = _distances("wall_jump", size, np.tile(middle, (count, 1)), "nothing")
    assert hands.min() > -CLOSE

    count = len(see("swing").qpos)
    bar = np.tile([BAR[0], 0.0, BAR[1]], (count, 1))
    assert _distances("swing", [0.015, 1.0, 0.015], bar, "wrist elbow").min() > 0.05

    seconds = np.arange(len(see("push").qpos)) / RATE
    speed = np.interp(seconds, [0.75, 1.05, 3.0, 3.3], [0.0, PUSHED / 2.25, PUSHED / 2.25, 0.0])
    face = FACE + np.concatenate([[0.0], np.cumsum(speed[1:] + speed[:-1]) / 2 / RATE])
    box = np.stack([face + 0.5, 0 * face, 0 * face + 0.7], axis=1)
    assert _distances("push", [0.5, 0.5, 0.7], box, "wrist").min() > 0.0
    assert _distances("push", [0.5, 0.5, 0.7], box, "nothing").min() > -CLOSE
