# SPDX-License-Identifier: Apache-2.0
"""A target to hit: where and when it is put, what a hit gives, and the reference's own impact."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character as character_lib
from jaxskills import kinematics, objects, recipes, trainer
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import measure, strike, task
from jaxskills.env.measure import Moment
from jaxskills.env.strike import Target
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.errors import UserError
from jaxskills.motion import CONTROL_DT, Motion
from jaxskills.physics.base import start
from jaxskills.trainer import TrainConfig

STEP = 1.0 / 120.0  # s
TARGET = Target("torso", share=0.5, mass=0.5, radius=0.1)
TORSO = 0.075 + 0.06  # m, how far it reaches from its centre
SPEED = 3.0  # m/s


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


@pytest.fixture(scope="module")
def flight(who: Character) -> Motion:
    """One second of gliding ahead at 3 m/s, high above the floor."""
    qpos = tiny.standing(31)
    qpos[:, 0], qpos[:, 2] = np.linspace(0.0, SPEED, 31), 2.0
    return tiny.make_motion(who, qpos, False)


@pytest.fixture(scope="module")
def both(who: Character, flight: Motion) -> tuple[Character, Motion]:
    return objects.add(who, flight, [strike.target(TARGET)])


@pytest.fixture(scope="module")
def before(both: tuple[Character, Motion]):
    """(qpos, qvel, phase, dphase) -> the same after the environment has seen to the target."""
    whole = both[0]
    scene, body = objects.scene(whole, 30.0), kinematics.body_params(whole.model)
    assert scene is not None
    act = jit(lambda *x: scene.before(start(x[0], x[1]), body, x[2], x[3]))

    def of(qpos, qvel, phase, dphase=1.0):
        rows = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, phase, dphase))
        sim, ctrl = act(*rows)
        assert ctrl.shape == (0,)
        return np.array(sim.qpos), np.array(sim.qvel)

    return of


def _gliding(whole: Character, speed: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    qpos, qvel = whole.model.qpos0.copy(), np.zeros(whole.model.nv)
    qpos[:3], qvel[:3] = (0.3, -0.2, 2.0), speed
    return qpos, qvel


@pytest.mark.parametrize(
    ("phase", "dphase", "speed", "put"),
    [
        (13.9, 1.0, 3.0, False),  # 1.1 control steps to go
        (14.0, 1.0, 3.0, True),
        (14.7, 1.0, 3.0, True),
        (15.0, 1.0, 3.0, False),  # too late
        (20.0, 1.0, 3.0, False),
        (13.9, 2.0, 3.0, True),  # it goes by twice as fast
        (13.0, 2.0, 3.0, True),
        (14.4, 0.5, 3.0, False),
        (14.5, 1.0, 0.4, False),  # that is no strike
    ],
)
def test_when_the_target_is_put(both, before, phase: float, dphase: float, speed: float, put: bool):
    qpos, qvel = _gliding(both[0], (speed, 0.0, 0.0))
    after, _ = before(qpos, qvel, phase, dphase)
    assert (np.abs(after[13:]).max() > 0.1) == put
    np.testing.assert_allclose(after[:13], qpos[:13], atol=1e-6)


@pytest.mark.parametrize("speed", [(3.0, 0.0, 0.0), (0.0, -2.0, 1.0), (4.0, 4.0, 2.0)])
def test_where_the_target_is_put(both, before, speed: tuple[float, float, float]):
    """Surfaces touch at the phase of the strike, 0.6 frames at double speed from now."""
    whole = both[0]
    qpos, qvel = _gliding(whole, speed)
    data = mujoco.MjData(whole.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(whole.model, data)
    after, speeds = before(qpos, qvel, 13.8, 2.0)
    way = np.array(speed) / np.linalg.norm(speed)
    apart = TARGET.radius + TORSO
    point = data.body("torso").xipos + np.array(speed) * 0.6 * CONTROL_DT + apart * way
    data.qpos[:] = after
    mujoco.mj_kinematics(whole.model, data)
    np.testing.assert_allclose(data.body("target").xpos, point, atol=1e-5)
    np.testing.assert_allclose(speeds, qvel, atol=1e-6)


def test_a_target_that_was_hit_is_left_alone(both, before):
    qpos, qvel = _gliding(both[0], (3.0, 0.0, 0.0))
    qpos[13:], qvel[11:] = (1.0, 0.0, 3.0), (2.0, 0.0, 1.0)
    after, speeds = before(qpos, qvel, 14.5)
    np.testing.assert_allclose(after, qpos, atol=1e-6)
    np.testing.assert_allclose(speeds, qvel, atol=1e-6)


def test_a_hit_keeps_momentum_and_comes_in_time(both, before):
    whole = both[0]

    def weightless(spec: mujoco.MjSpec) -> None:
        spec.option.gravity = [0.0, 0.0, 0.0]

    model = character_lib.placed(whole, [weightless], STEP).model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = _gliding(whole, (SPEED, 0.0, 0.0))
    data.qpos[:], data.qvel[:] = before(data.qpos, data.qvel, 14.25)
    given, own = [], []
    for _ in range(24):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        target = TARGET.mass * data.qvel[11:14]
        given.append(np.linalg.norm(target))
        own.append(data.subtree_linvel[1] * whole.mass + target)
    # 0.75 control steps are 3 physics steps; the torso is no ball, so it comes to touch later.
    assert max(given[:3]) < 1e-6 < given[9]
    np.testing.assert_allclose(own, [[SPEED * whole.mass, 0.0, 0.0]] * 24, atol=0.02)
    assert 0.5 * SPEED * TARGET.mass < given[-1] < 2.1 * SPEED * TARGET.mass


def test_a_waiting_target_does_not_move(both):
    model, data = both[0].model, mujoco.MjData(both[0].model)
    data.qpos[2] = 9.0
    mujoco.mj_step(model, data, nstep=120)
    assert np.abs(data.qpos[13:]).max() < 1e-9


def test_the_impact_is_the_momentum(both):
    made = strike.impact(TARGET)
    read = made.quantity(both[0])
    qvel = jnp.zeros(14).at[11:].set(jnp.array([3.0, 0.0, 4.0]))
    moment = Moment(None, None, jnp.zeros(16), qvel)  # type: ignore
    assert float(read(moment)) == pytest.approx(5.0 * TARGET.mass)
    assert (made.kind, made.begin, made.end) == ("largest", 0.4, 0.6)
    assert strike.impact(TARGET, 0.9).end == 0.9


def test_the_references_own_impact(both):
    """A strike without servo forces: the walker glides at its zero pose into a light target."""
    whole, shown = both
    asked = Parameter("force", (1.0, 5.0), measure=strike.impact(TARGET))
    found = task.reference_values(TaskSpec((asked,)), whole, shown)[0]
    model = character_lib.compile(whole, STEP)
    data, at = mujoco.MjData(model), objects.place(whole, "target")
    data.qpos[:13] = shown.qpos[14][:13]
    data.qvel[:] = shown.qvel[14]
    mujoco.mj_kinematics(model, data)
    apart = TARGET.radius + TORSO + SPEED * CONTROL_DT
    data.qpos[at.qpos] = data.body("torso").xipos + [apart, 0.0, 0.0] - at.home
    speeds = []
    for _ in range(16):  # to share 0.6
        # As good as the limited servos, where they need not push much.
        mujoco.mj_step(model, data)
        speeds.append(np.linalg.norm(data.qvel[at.dofs]))
    assert found == pytest.approx(TARGET.mass * speeds[-1], rel=0.05)
    assert found > 0.5 * SPEED * TARGET.mass


def test_the_impact_of_an_environment_is_known(both):
    """What the policy is paid by is what happened."""
    whole, shown = both
    asked = Parameter("force", (1.0, 5.0), measure=strike.impact(TARGET))
    made = asked.measure
    assert made is not None
    known, read = measure.start(made), made.quantity(whole)
    for i, speed in enumerate((0.0, 0.0, 2.5, 2.0)):
        shares = jnp.float32(0.4 + 0.05 * i), jnp.float32(0.45 + 0.05 * i)
        now = Moment(None, None, None, jnp.zeros(14).at[12].set(speed))  # type: ignore
        last = Moment(None, None, None, jnp.zeros(14))  # type: ignore
        known = measure.update(made, known, read(last), read(now), shares, CONTROL_DT)
    assert float(measure.value(made, known)) == pytest.approx(2.5 * TARGET.mass)


@pytest.mark.parametrize("name", ["punch_family", "sidekick_family"])
def test_shipped_strikes_are_where_the_body_is_fast(name: str, deepmimic):
    recipe = recipes.find(name)
    assert recipe.task is not None
    who = character_lib.load(recipe.character)
    shown = trainer.reference(TrainConfig(clip=recipe.clip), who)
    spec = dataclasses.replace(
        recipe.task, parameters=tuple(p for p in recipe.task.parameters if p.name != "force")
    )
    made = task.make(spec, who, shown)
    found = {p.name: share for p, share in zip(spec.free, made.base, strict=True)}
    assert found["angle"] == pytest.approx(0.0, abs=0.01)
    assert found["height"] == pytest.approx(0.5, abs=1e-3)
    force = next(p for p in recipe.task.parameters if p.name == "force").measure
    assert force is not None
    share, data = force.begin + 0.1, mujoco.MjData(who.model)
    body = {"punch_family": "right_wrist", "sidekick_family": "right_ankle"}[name]
    speeds = []
    for qpos, qvel in zip(np.asarray(shown.qpos), np.asarray(shown.qvel), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(who.model, data)
        speed = np.zeros(6)
        which = mujoco.mjtObj.mjOBJ_BODY, who.model.body(body).id
        mujoco.mj_objectVelocity(who.model, data, *which, speed, 0)
        speeds.append(np.linalg.norm(speed[3:]))
    assert speeds[round(share * (len(speeds) - 1))] > 0.9 * max(speeds)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"share": 0.0}, "target.share is 0.0: give a phase between 0 and 1"),
        ({"mass": 0.0}, "target.mass is 0.0: give a number above 0"),
        ({"radius": -1.0}, "target.radius is -1.0: give a number above 0"),
        ({"lead": 0.5}, "target.lead is 0.5: give 1 to 30 control steps"),
    ],
)
def test_a_broken_target(changes: dict, message: str):
    with pytest.raises(UserError) as raised:
        strike.target(dataclasses.replace(TARGET, **changes))
    assert str(raised.value) == message


def test_a_body_that_is_none(who: Character, flight: Motion):
    with pytest.raises(UserError) as raised:
        objects.add(who, flight, [strike.target(dataclasses.replace(TARGET, body="fin"))])
    assert str(raised.value) == (
        "unknown body that strikes 'fin': choose one of pelvis, torso, left_leg, right_leg"
    )
