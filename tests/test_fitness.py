# SPDX-License-Identifier: Apache-2.0
"""Fitness: 1 for the reference, less for every fault, each factor against a loop over MuJoCo."""

import dataclasses
import itertools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny
import variations

from jaxskills import ground, kinematics
from jaxskills.character import Character
from jaxskills.env import obstacles
from jaxskills.env.task import TaskSpec, placed
from jaxskills.errors import UserError
from jaxskills.explore import fitness as lib
from jaxskills.explore.fitness import Fitness, FitnessConfig
from jaxskills.motion import CONTROL_DT, Motion

# Scales at which the faults of these tests matter.
CONFIG = FitnessConfig(velocity=10.0, contact=0.1, drag=0.05)
ROWS = 64
Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
FACTORS = ("pose", "velocity", "contact", "drag")


@pytest.fixture(scope="module")
def bow(who: Character) -> Motion:
    """Feet planted, the spine bends to and fro while the walker lifts itself off at the end."""
    qpos = tiny.standing(31)
    half = 0.2 * np.sin(np.linspace(0.0, 2.0 * np.pi, 31))
    qpos[:, tiny.SPINE] = np.stack((np.cos(half), 0 * half, np.sin(half), 0 * half), 1)
    qpos[20:, 2] += np.linspace(0.0, 0.2, 11)
    return tiny.make_motion(who, qpos, loop=False)


@pytest.fixture(scope="module")
def judge(who: Character, bow: Motion) -> Callable[..., Fitness]:
    """(rows, constraint) -> fitness."""
    compiled = jax.jit(lib.make(who, bow, CONFIG))

    def of(rows: Rows, constraint: float = 0.0) -> Fitness:
        arrays = [np.asarray(row, bool if row.dtype == bool else np.float32) for row in rows]
        return jax.tree.map(float, compiled(*arrays, jnp.float32(constraint)))

    return of


def _episode(bow: Motion, qpos: np.ndarray | None = None, qvel: np.ndarray | None = None) -> Rows:
    """Returns the rows of an episode at phases 0 to 30, the others full of nan."""
    rows = np.full((ROWS, 13), np.nan), np.full((ROWS, 11), np.nan), np.full(ROWS, np.nan)
    rows[0][:31] = bow.qpos if qpos is None else qpos
    rows[1][:31] = bow.qvel if qvel is None else qvel
    rows[2][:31] = np.arange(31.0)
    return *rows, np.isfinite(rows[2])


def _faulty(who: Character, bow: Motion, seed: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns poses and velocities off the motion by smooth errors of everything."""
    error = np.array(variations.smooth(31, 11, seed=seed, size=size).d)
    poses = zip(np.array(bow.qpos, float), error, strict=True)
    qpos = np.stack([variations.plus(who.model, q, d) for q, d in poses])
    random = np.random.default_rng(seed)
    return qpos, np.array(bow.qvel) + 5.0 * size * random.normal(size=(31, 11))


def _look(who: Character, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns heights `[N, E]` of the lowest corners of the end effectors, and where they are."""
    heights, places = [], []
    for pose in qpos:
        data = mujoco.MjData(who.model)
        data.qpos = pose
        mujoco.mj_kinematics(who.model, data)
        height, place = [], []
        for name in who.end_effectors:
            body = who.body(name) + 1
            lowest = []
            for geom in np.flatnonzero(who.model.geom_bodyid == body):
                if who.model.geom_contype[geom]:
                    lowest += _points(who.model, data, int(geom))
            height.append(min(lowest))
            place.append(data.xpos[body, :2].copy())
        heights.append(height)
        places.append(place)
    return np.array(heights), np.array(places)


def _points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[float]:
    """Returns heights of the corners of a box, or of a capsule's lowest points."""
    turn, center = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
    size = model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        corners = itertools.product((-1.0, 1.0), repeat=3)
        return [float((center + turn @ (size * np.array(corner)))[2]) for corner in corners]
    ends = [center + sign * size[1] * turn[:, 2] for sign in (-1.0, 1.0)]
    return [float(end[2] - size[0]) for end in ends]


def test_the_reference_itself_is_worth_one(judge: Callable, bow: Motion):
    found = judge(_episode(bow))
    np.testing.assert_allclose(dataclasses.astuple(found), 1.0, atol=1e-5)


def test_a_reference_that_slips_is_told_so(who: Character):
    """A walk whose planted foot moves with its swinging leg: only its drag is below 1."""
    walk = tiny.make_motion(who, tiny.walking(), loop=False)
    heights, places = _look(who, np.array(walk.qpos))
    seen = lib.Measures(walk.qpos, walk.qvel, jnp.asarray(heights), jnp.asarray(places))
    compiled = jax.jit(lib.fitness, static_argnums=(0, 1))
    found = compiled(CONFIG, who.layout, seen, seen, jnp.float32(0.0))
    stays = (heights[1:] < 0.03) & (heights[:-1] < 0.03)
    slip = np.sum(stays * np.sum(np.diff(places, axis=0) ** 2, -1)) / 31
    assert float(found.drag) == pytest.approx(math.exp(-slip / 0.05**2), rel=1e-4)
    assert float(found.total) == pytest.approx(float(found.drag)) and found.drag < 0.99


@pytest.mark.parametrize("size", [0.05, 0.2])
def test_each_factor_is_that_of_a_loop(who: Character, bow: Motion, judge: Callable, size: float):
    """FS eq. 10 word by word, for an episode whose rows lie on the knots."""
    qpos, qvel = _faulty(who, bow, 0, size)
    wanted, speed = np.array(bow.qpos, float), np.array(bow.qvel, float)
    (height, place), (high, _) = _look(who, qpos), _look(who, wanted)
    touching = high < CONFIG.contact_height
    assert 0 < touching[:, 1:].sum() < touching[:, 1:].size and not touching[:, 0].any()
    error = dict.fromkeys(FACTORS, 0.0)
    for k in range(31):
        offset = variations.minus(who.model, wanted[k], qpos[k])
        for joint in who.layout.joints[1:]:
            axes = list(joint.dofs)
            error["pose"] += np.linalg.norm(offset[axes]).item() ** 2
            fast = max(0.5, np.linalg.norm(speed[k, axes]).item() ** 2)
            error["velocity"] += np.linalg.norm(speed[k, axes] - qvel[k, axes]).item() ** 2 / fast
        for j in range(3):
            error["contact"] += touching[k, j] * (high[k, j] - height[k, j]) ** 2
            if k > 0 and touching[k, j] and touching[k - 1, j]:
                error["drag"] += np.linalg.norm(place[k, j] - place[k - 1, j]).item() ** 2
    expected = {n: error[n] / 31 / getattr(CONFIG, n) ** 2 for n in FACTORS}
    for name in ("pose", "velocity"):  # scales are for 57 axes
        expected[name] *= 57 / (who.layout.nv - 6)
    found = judge(_episode(bow, qpos, qvel), constraint=0.5)
    for name in FACTORS:
        exponent = -math.log(getattr(found, name))
        assert exponent == pytest.approx(expected[name], rel=2e-3, abs=2e-6), name
        assert exponent > 2e-4
    product = math.exp(-sum(expected.values()))
    assert found.total == pytest.approx(product + 0.1 * 0.5, rel=2e-3)


@pytest.mark.parametrize(
    ("kind", "lowered"),
    [
        ("joint", {"pose"}),
        ("speed", {"velocity"}),
        ("height", {"contact"}),
        ("slip", {"drag"}),
        ("flight", set()),
        ("root", set()),
    ],
)
def test_worse_faults_cost_more_and_only_their_factor(
    bow: Motion, judge: Callable, kind: str, lowered: set[str]
):
    """Half of the frames are at fault, ever more: a bent spine, a fast one, feet above the ground,
    feet that slip; a higher jump and a moving, turning root are none."""
    before = dict.fromkeys(FACTORS, 1.0)
    for size in (0.05, 0.1, 0.2, 0.4):
        qpos, qvel = np.array(bow.qpos, float), np.array(bow.qvel, float)
        if kind == "joint":
            half = 0.5 * (size + 2.0 * np.arctan2(qpos[:15, 9], qpos[:15, 7]))
            qpos[:15, tiny.SPINE] = np.stack((np.cos(half), 0 * half, np.sin(half), 0 * half), 1)
        elif kind == "speed":
            qvel[:15, 7] += 10.0 * size
        elif kind == "height":
            qpos[:15, 2] += size
        elif kind == "slip":
            qpos[:, 0] += size * np.arange(31) / 30
        elif kind == "flight":
            qpos[25:, 2] += size
        else:
            qpos = variations.turned(qpos, 10.0 * size, (size, -size))
            qvel[:, :3] += size
            qvel[:, 5] += size
        found = judge(_episode(bow, qpos, qvel))
        for name in FACTORS:
            value = getattr(found, name)
            if name in lowered:
                assert value < before[name] - 1e-4, (name, size)
                assert found.total == pytest.approx(value, rel=1e-3)
            else:
                assert value == pytest.approx(1.0, abs=1e-4), (name, size)
            before[name] = value


def test_a_lift_of_ground_and_motion_counts_nothing(who: Character, bow: Motion, judge: Callable):
    """A faulty episode on a box of 0.7 m is worth what it is worth on the floor, and less below it.

    It is then judged by the ground that it has under it.
    """
    qpos, qvel = _faulty(who, bow, 3, 0.1)
    here = judge(_episode(bow, qpos, qvel))
    box = obstacles.box((0.0, 0.0), (20.0, 20.0), 0.7)
    among = placed(TaskSpec(scenery=(box,)), who).model
    own = kinematics.body_params(among), ground.shapes(among)
    compiled = jax.jit(lib.make(who, bow, CONFIG))
    for lift, same in ((0.7, True), (0.5, False)):
        moved = qpos + np.eye(13)[2] * lift
        rows = [jnp.asarray(row) for row in _episode(bow, moved, qvel)]
        found = jax.tree.map(float, compiled(*rows, jnp.float32(0.0), own))
        for name in FACTORS:
            if name != "contact" or same:
                assert getattr(found, name) == pytest.approx(getattr(here, name), rel=1e-3), name
        assert same or found.contact < 0.01 < here.contact


def test_where_it_happens_and_which_way_it_faces_counts_nothing(
    who: Character, bow: Motion, judge: Callable
):
    qpos, qvel = _faulty(who, bow, 1, 0.1)
    here = judge(_episode(bow, qpos, qvel))
    there = judge(_episode(bow, variations.turned(qpos, 2.0, (20.0, -30.0)), qvel))
    np.testing.assert_allclose(
        dataclasses.astuple(here), dataclasses.astuple(there), rtol=1e-3, atol=1e-4
    )


def test_time_may_be_warped(who: Character, bow: Motion, judge: Callable):
    """The same poses at half speed, 61 rows of half a frame: only the velocities tell."""
    rows = _episode(bow)
    rows[2][:61], rows[3][:61] = np.linspace(0.0, 30.0, 61), True
    for row, phase in zip(range(61), rows[2], strict=False):
        rows[0][row] = variations.reference_at(who.model, bow, phase)
        rows[1][row] = [0.5 * np.interp(phase, np.arange(31.0), x) for x in np.array(bow.qvel).T]
    slow = judge(rows)
    kept = [getattr(slow, name) for name in ("pose", "contact", "drag")]
    np.testing.assert_allclose(kept, 1.0, atol=1e-4)
    assert 0.9 < slow.velocity < 0.9999


def test_unused_rows_do_not_count_and_nothing_is_worth_nothing(bow: Motion, judge: Callable):
    rows = _episode(bow)
    for row in rows[:3]:
        row[31:] = 1e6
    assert judge(rows).total == pytest.approx(1.0, abs=1e-5)
    for row in rows[:3]:
        row[:] = np.nan
    assert dataclasses.astuple(judge(rows, constraint=1.0)) == (0.0,) * 6
    rows[3][:] = False
    assert dataclasses.astuple(judge(rows)) == (0.0,) * 6


def test_constraints_come_on_top(bow: Motion, judge: Callable):
    rows = _episode(bow)
    with_them, without = judge(rows, 1.0), judge(rows)
    assert without.total == without.likeness == with_them.likeness
    assert with_them.total == pytest.approx(without.total + 0.1, abs=1e-6)


def test_many_at_once(who: Character, bow: Motion, judge: Callable):
    episodes = [_episode(bow, *_faulty(who, bow, seed, 0.1)) for seed in range(3)]
    batch = [jnp.asarray(np.stack(rows * 50)) for rows in zip(*episodes, strict=True)]
    found = jax.jit(jax.vmap(lib.make(who, bow, CONFIG)))(*batch, jnp.zeros(150))
    assert found.total.shape == (150,)
    for i in (0, 1, 149):
        assert float(found.total[i]) == pytest.approx(judge(episodes[i % 3]).total, rel=1e-3)


def test_which_contacts_count(who: Character):
    assert lib.contact_bodies(who, ground.shapes(who.model)) == (1, 2, 3)
    fewer = dataclasses.replace(who, end_effectors=("torso",), ground=("torso", "left_leg"))
    assert lib.contact_bodies(fewer, ground.shapes(who.model)) == (1, 2)


def test_a_knot_every_control_frame(bow: Motion):
    np.testing.assert_allclose(lib.phases(bow), np.arange(31.0), rtol=1e-6)
    np.testing.assert_allclose(bow.seconds / CONTROL_DT, 30.0)


def test_the_numbers_are_the_papers():
    """FS section 5.1, lengths in dm; what a contact is it leaves open."""
    found = dataclasses.asdict(FitnessConfig())
    assert found.pop("contact_height") == 0.03
    lengths = [10.0 * found.pop(name) for name in ("contact", "drag")]
    np.testing.assert_allclose(lengths, (1.3, 0.7))
    assert tuple(found.values()) == (2.67, 75.5, 0.5, 0.1)


def test_out_of_range():
    lib.validate(FitnessConfig())
    bad = (("pose", 0.0), ("drag", float("inf")), ("constraint", 2.0), ("contact_height", 5.0))
    for name, value in bad:
        with pytest.raises(UserError, match=f"fitness.{name} is"):
            lib.validate(FitnessConfig(**{name: value}))
