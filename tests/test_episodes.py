# SPDX-License-Identifier: Apache-2.0
"""Whole episodes found in a record of many environments, against a plain search."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import ground, kinematics
from jaxskills.character import Character
from jaxskills.env import measure, task
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.explore import episodes
from jaxskills.explore.episodes import Record
from jaxskills.explore.fitness import FitnessConfig
from jaxskills.explore.fitness import make as make_judge

HEIGHT = TaskSpec((Parameter("height", (0.5, 1.5), measure=measure.at(0.5, measure.com_height)),))
STEPS, ENVS, LENGTH = 100, 6, 30.0


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


def _record(who: Character) -> tuple[Record, list[tuple[int, int, int]]]:
    """Returns a record and the episodes in it that are whole: last step, environment, first step.

    In environment e phase goes by at 1 + e / 10; the pelvis is e cm too high. Environment 1 begins
    in the middle each time, environment 2 fails half way.
    """
    qpos = np.tile(tiny.standing(1)[0], (STEPS, ENVS, 1))
    shape = (STEPS, ENVS)
    phase, speed, step = np.zeros(shape), np.ones(shape), np.zeros(shape, int)
    finished, whole = np.zeros(shape, bool), []
    known = np.zeros((STEPS, ENVS, 1, 2))
    for e in range(ENVS):
        qpos[:, e, 2] += 0.01 * e
        speed[:, e], now, count = 1.0 + e / 10.0, LENGTH / 2 if e == 1 else 0.0, 0
        known[:, e, 0, 0] = 0.4 + 0.01 * e
        for t in range(STEPS):
            phase[t, e], step[t, e] = now, count
            now, count = now + speed[t, e], count + 1
            if now >= LENGTH + 5.0:
                finished[t, e] = True
                if e != 1:
                    whole.append((t, e, t - count + 1))
            if finished[t, e] or (e == 2 and now > LENGTH / 2):
                now, count = LENGTH / 2 if e == 1 else 0.0, 0
    arrays = (qpos, np.zeros((*shape, who.layout.nv)), phase, speed)
    arrays = [jnp.asarray(x, jnp.float32) for x in arrays]
    return Record(
        *arrays, jnp.asarray(step), jnp.asarray(known, jnp.float32), jnp.asarray(finished)
    ), sorted(whole)


def test_whole_episodes_are_found_with_what_they_did(who: Character):
    stand = tiny.make_motion(who, tiny.standing(31), False)
    asks = task.make(HEIGHT, who, stand)
    record, whole = _record(who)
    judge = make_judge(who, stand, FitnessConfig())
    motions = dataclasses.replace(
        stand,
        **{
            name: jnp.stack([getattr(stand, name)] * 2)
            for name in ("qpos", "qvel", "length", "cycle_pos", "cycle_yaw")
        },
    )
    variant = jnp.arange(ENVS) % 2
    most = episodes.room(STEPS, ENVS, 15)
    asked = jnp.array([[0.5], [0.6]])
    own = kinematics.body_params(who.model), ground.shapes(who.model)
    own = jax.tree.map(lambda x: jnp.stack([x, x]), own)
    of = who.layout, motions, own, asks, judge, record
    found = episodes.finished(*of, asked, variant, 4, 50, most)
    valid = np.asarray(found.episodes.valid)
    assert valid.sum() == len(whole) and 0 < len(whole) < most
    places = np.argwhere(np.asarray(episodes.whole(record)))
    assert [tuple(place) for place in places] == [(t, e) for t, e, _ in whole]
    own = float(asks.reference[0])
    for row, (_, e, _) in enumerate(whole):
        assert int(found.variant[row]) == e % 2
        assert float(found.episodes.a[row, 0]) == pytest.approx((0.4 + 0.01 * e) / own - 0.5)
        knots = np.asarray(found.episodes.x[row]).reshape(4, -1)
        np.testing.assert_allclose(knots[:, 2], 0.01 * e, atol=1e-5)
        np.testing.assert_allclose(knots[:, -1], np.log(1.0 + e / 10.0), atol=1e-5)
    fitness = np.asarray(found.episodes.fitness)[: len(whole)]
    by_height = [fitness[row] for row, (_, e, _) in enumerate(whole) if e in (0, 5)]
    assert max(by_height) == pytest.approx(1.0, abs=0.02) and min(by_height) < max(by_height)


def test_room_is_in_whole_groups_and_holds_all():
    assert episodes.room(100, 6, 15) == 64
    assert episodes.room(10, 6, 15) == 32
    for steps, envs, shortest in ((144, 160, 20), (33, 7, 5)):
        room = episodes.room(steps, envs, shortest)
        assert room % 32 == 0 and room >= envs * (steps // shortest)
