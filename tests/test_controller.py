# SPDX-License-Identifier: Apache-2.0
"""A family played interactively: one performance goes over into the next, where it stands."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_family

from jaxskills import controller, families, rotation
from jaxskills.compilation import jit
from jaxskills.controller import Controller, Playing
from jaxskills.errors import UserError


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Controller:
    made = families.make(tiny_family.config(tmp_path_factory.mktemp("walks")))
    return controller.family_controller(made, tiny_family.trained(made))


@pytest.fixture(scope="module")
def step(walks: Controller) -> Callable[[Playing], tuple[Playing, jax.Array]]:
    return jit(walks.step)


@pytest.fixture(scope="module")
def course(walks: Controller, step) -> list[tuple[Playing, np.ndarray]]:
    """Three seconds, after one of which another height is asked for."""
    now, seen = walks.start(walks.parameters(height=0.7, gravity=1.0)), []
    for count in range(90):
        if count == 10:
            now = walks.ask(now, walks.parameters(height=1.3, gravity=2.0))
        now, qpos = step(now)
        seen.append((now, np.asarray(qpos)))
    return seen


def test_parameters_have_names_and_the_reference_fills_in(walks: Controller):
    np.testing.assert_allclose(walks.parameters(height=0.7), [0.2, 1 / 3], atol=1e-6)
    np.testing.assert_allclose(walks.parameters(), [0.5, 1 / 3], atol=1e-6)
    with pytest.raises(UserError, match="task parameter height is 3: give 0.5 to 1.5"):
        walks.parameters(height=3)


def test_another_task_begins_with_the_next_cycle(course: list[tuple[Playing, np.ndarray]]):
    """Conditions stay: they are part of a model that is compiled."""
    for now, _ in course:
        first = int(now.performances) == 0
        expected = [0.2 if first else 0.8, 1 / 3]
        np.testing.assert_allclose(now.asked.a[0], expected, atol=1e-6)
    counts = [int(now.performances) for now, _ in course]
    assert counts[0] == 0 and counts[-1] >= 2 and set(np.diff(counts)) == {0, 1}
    for (before, _), (after, _) in zip(course, course[1:], strict=False):
        if int(after.performances) > int(before.performances):
            assert float(after.state.phase) < 3.0 < 27.0 < float(before.state.phase)
            assert int(after.state.step) == 0


def test_the_world_sees_one_motion(course: list[tuple[Playing, np.ndarray]]):
    """Where performances meet, the character goes on as it went: it only totters, untrained."""
    path = np.stack([qpos[:3] for now, qpos in course if not bool(now.fallen)])
    counts = [int(now.performances) for now, _ in course[: len(path)]]
    assert counts[-1] == 2
    moved = np.diff(path, axis=0)
    assert np.linalg.norm(moved, axis=1).max() < 0.1
    assert np.abs(np.diff(moved, axis=0)).max() < 0.02


def test_each_performance_begins_where_the_character_is(
    walks: Controller, course: list[tuple[Playing, np.ndarray]]
):
    """The reference is put below it, facing as it faces, level and without tilting."""
    reference_of = jit(walks.reference)
    assert int(course[0][0].performances) == 0
    for (before, _), (now, qpos) in zip(course, course[1:], strict=False):
        if int(now.performances) > int(before.performances):
            reference = np.asarray(reference_of(now))
            np.testing.assert_allclose(reference[:2], qpos[:2], atol=1e-4)
            apart = rotation.mul(reference[3:7], rotation.inv(jnp.asarray(qpos[3:7])))
            assert abs(float(apart[3])) < 1e-3
            went = reference_of(course[-1][0])[:2] - reference[:2]
            assert float(jnp.linalg.norm(went)) > 0.1


def test_putting_back_changes_nothing_in_the_world(course: list[tuple[Playing, np.ndarray]]):
    """The simulation, turned and shifted onto its reference, is in the world as it was."""
    now = course[40][0]
    now = dataclasses.replace(now, turn=jnp.float32(0.7), shift=jnp.array([1.0, 2.0, 0.0]))
    sim, turn = now.state.sim, jnp.float32(-0.4)
    away = jnp.array([0.3, -0.2, 0.0])
    moved = controller._moved(sim, turn, away)
    new_turn = now.turn - turn
    shift = now.shift - _turned(new_turn, away)
    after = dataclasses.replace(now, turn=new_turn, shift=shift)
    before = controller._in_world(now, sim.qpos)
    np.testing.assert_allclose(controller._in_world(after, moved.qpos), before, atol=1e-5)
    velocities = (_turned(x.turn, y.qvel[:3]) for x, y in ((after, moved), (now, sim)))
    np.testing.assert_allclose(*velocities, atol=1e-5)
    np.testing.assert_array_equal(moved.qvel[3:], sim.qvel[3:])


def test_matching_roots():
    qpos = jnp.array([1.0, 2.0, 0.9, *_yaw(0.5), 0.3])
    target = jnp.array([-1.0, 0.5, 0.7, *_yaw(2.5), 0.1])
    turn, shift = controller._matching(qpos, target)
    assert float(turn) == pytest.approx(2.0, abs=1e-5)
    np.testing.assert_allclose(_turned(turn, qpos[:3]) + shift, [-1.0, 0.5, 0.9], atol=1e-5)


def _turned(turn: jax.Array, v: jax.Array) -> jax.Array:
    return rotation.rotate(rotation.about_z(turn), v)


def _yaw(angle: float) -> tuple[float, ...]:
    return float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2))


def test_a_new_start_stands_where_the_character_stood(
    walks: Controller, step, course: list[tuple[Playing, np.ndarray]]
):
    """In another gravity, which takes a new model."""
    now, qpos = course[-1]
    again = walks.start(walks.parameters(gravity=2.0), now)
    assert int(again.performances) == int(now.performances) + 1
    after, there = step(again)
    np.testing.assert_allclose(there[:2], qpos[:2], atol=0.05)
    assert float(after.asked.a[0, 1]) == pytest.approx(1.0)


def test_the_same_beginning_goes_the_same_way(
    walks: Controller, step, course: list[tuple[Playing, np.ndarray]]
):
    now = walks.start(walks.parameters(height=0.7, gravity=1.0))
    for _, expected in course[:10]:
        now, qpos = step(now)
        np.testing.assert_array_equal(qpos, expected)
