# SPDX-License-Identifier: Apache-2.0
"""The environment: starts, steps, every way an episode ends, and what the servos are told."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character, ground, kinematics, motion
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, core, variants
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig, Environment, EnvState, Outcome
from jaxskills.errors import UserError
from jaxskills.motion import CONTROL_DT, Motion
from jaxskills.physics import SimState, servo

STILL = np.zeros(5, np.float32)  # the action that changes nothing
LIMIT = 600  # steps in the 20 s of the default time limit


class Running(NamedTuple):
    """An environment and its compiled functions."""

    env: Environment
    start: Callable[[jax.Array], EnvState]
    step: Callable[[EnvState, jax.Array], tuple[EnvState, Outcome]]


def _running(env: Environment) -> Running:
    return Running(env, jit(env.start), jit(env.step))


@pytest.fixture(scope="module")
def walker(who: Character, walk: Motion) -> Running:
    """The walk on the real engine."""
    return _running(tiny.make_env(who, walk))


def _frozen(
    who: Character,
    qpos: np.ndarray,
    loop: bool,
    config: EnvConfig = EnvConfig(),  # noqa: B008
    sizes: BoundsConfig = BoundsConfig(),  # noqa: B008
) -> Environment:
    """Returns an environment where nothing ever moves; its engine only remembers the controls."""
    made = bounds.make(who, sizes)
    only = variants.one(who, tiny.make_motion(who, qpos, loop), None)
    return core.make(who, only, tiny.stopped(), made, config)


@pytest.fixture(scope="module")
def stand(who: Character) -> Running:
    """A frozen stand 5 cm above the floor, which the left leg must not touch."""
    qpos = tiny.standing()
    qpos[:, 2] = 0.55
    return _running(_frozen(who, qpos, True, sizes=BoundsConfig(no_ground_contact=("left_leg",))))


@pytest.fixture(scope="module")
def faller(who: Character) -> Running:
    """A frozen stand in which only falls end an episode."""
    config = EnvConfig(stop="fall", reward="imitation")
    return _running(_frozen(who, tiny.standing(), True, config))


@pytest.fixture(scope="module")
def careful(who: Character) -> Running:
    """A frozen stand in wide bounds, in which a fall ends an episode too."""
    sizes = BoundsConfig((0.8, 0.8, 0.8), 4.0, np.inf, np.inf)
    return _running(_frozen(who, tiny.standing(), True, EnvConfig(stop="either"), sizes))


@pytest.fixture(scope="module")
def roller(who: Character) -> Running:
    """A frozen stand in which every body may touch the ground."""
    config = EnvConfig(stop="fall", may_touch=("pelvis", "torso", "left_leg", "right_leg"))
    return _running(_frozen(who, tiny.standing(), True, config))


@pytest.fixture(scope="module")
def once(who: Character) -> Running:
    """A frozen motion of a second without loop: in the floor, on it, above it, on tilted legs."""
    qpos = tiny.standing(31)
    qpos[:10, 2], qpos[20:, 2] = 0.4, 0.8
    qpos[15:20, tiny.LEFT_HIP] = 0.3
    sizes = BoundsConfig(channels={"com_x": (0.1, 0.5)})
    return _running(_frozen(who, qpos, False, EnvConfig(feedforward=False), sizes))


def _displaced(who: Character, **by_dof: float) -> np.ndarray:
    """Returns the upright pose with displacements added, given as `d3=0.1`."""
    d = np.zeros(who.layout.nv)
    for name, value in by_dof.items():
        d[int(name[1:])] = value
    qpos = tiny.standing(1)[0]
    mujoco.mj_integratePos(who.model, qpos, d, 1.0)
    return qpos


def _put(qpos: np.ndarray, phase: float = 0.0, step: int = 0, diverged: bool = False) -> EnvState:
    """Returns a state by hand, at rest."""
    sim = SimState(jnp.asarray(qpos, jnp.float32), *jnp.zeros((2, 11)), jnp.bool_(diverged))
    return EnvState(sim, jnp.float32(phase), jnp.int32(step), jnp.int32(0))


def _push(index: int, value: float) -> jax.Array:
    """Returns an action of one number."""
    return jnp.zeros(5).at[index].set(value)


def _after(running: Running, state: EnvState) -> tuple[bool, bool, str]:
    """Returns whether a step terminates, whether it truncates, and the name of the ending."""
    _, outcome = running.step(state, STILL)
    ended_by = running.env.endings[int(outcome.report.ended_by)]
    return bool(outcome.terminated), bool(outcome.truncated), ended_by


# Starts


@pytest.mark.parametrize("phase", [0.0, 4.5, 100.25])
def test_a_start_is_the_reference(who: Character, walk: Motion, walker: Running, phase: float):
    qpos, qvel = motion.sample(who.layout, walk, jnp.float32(phase))
    state = walker.start(jnp.float32(phase))
    np.testing.assert_allclose(np.delete(state.sim.qpos, 2), np.delete(qpos, 2), atol=1e-6)
    np.testing.assert_allclose(state.sim.qvel, qvel, atol=1e-6)
    assert (float(state.phase), int(state.step)) == (phase, 0)
    assert not bool(state.sim.diverged)


def test_a_start_is_lifted_out_of_the_floor_and_no_further(who: Character, once: Running):
    for phase, height in ((4.0, 0.501), (12.0, 0.501), (25.0, 0.8)):
        qpos = once.start(jnp.float32(phase)).sim.qpos
        np.testing.assert_allclose(qpos[2], height, atol=1e-5)
    tilted = once.start(jnp.float32(17.0)).sim.qpos
    tree, params = kinematics.tree(who.model), kinematics.body_params(who.model)
    shapes = ground.shapes(who.model)
    lowest = jit(
        lambda q: ground.clearance(
            shapes, kinematics.kinematics(tree, params, q, jnp.zeros(who.layout.nv))
        ).min()
    )
    assert float(tilted[tiny.LEFT_HIP]) == pytest.approx(0.3)
    assert float(lowest(tilted)) == pytest.approx(1e-3, abs=1e-5)


# Steps


def test_a_step_goes_one_control_frame_on(walker: Running):
    state = walker.start(jnp.float32(3.25))
    observe = jit(walker.env.observe)
    for count in range(1, 4):
        state, outcome = walker.step(state, STILL)
        assert (float(state.phase), int(state.step)) == (3.25 + count, count)
        assert (bool(outcome.terminated), bool(outcome.truncated)) == (False, False)
        assert (float(outcome.spike), float(outcome.rate), float(outcome.dphase)) == (1.0, 0.0, 1.0)
        assert bool(outcome.report.inside)
        np.testing.assert_allclose(outcome.obs, observe(state), atol=1e-5)


def test_the_same_inputs_give_the_same_bits(walker: Running):
    actions = 0.2 * jax.random.normal(jax.random.key(0), (6, 5))

    def run() -> list[Any]:
        state, rows = walker.start(jnp.float32(7.0)), []
        for action in actions:
            state, outcome = walker.step(state, action)
            rows.append(jax.tree.map(np.asarray, (state, outcome)))
        return rows

    jax.tree.map(np.testing.assert_array_equal, run(), run())


def test_an_action_moves_the_joint_it_names(walker: Running):
    """Actions are in the order of the servos: three of the spine, left hip, right hip."""
    assert walker.env.action_size == 5
    begin = walker.start(jnp.float32(0.0))
    for index, qpos in ((0, 8), (1, 9), (2, 10), (3, tiny.LEFT_HIP), (4, tiny.RIGHT_HIP)):
        ends = [walker.step(begin, _push(index, s))[0].sim.qpos for s in (0.4, -0.4)]
        change = np.asarray(ends[0] - ends[1])[7:]
        assert np.abs(change).argmax() == qpos - 7
        assert change[qpos - 7] > 0


def test_targets_are_displacements_from_the_reference_ahead(who: Character, walk: Motion):
    """By `lead` control frames; without feedforward, from the zero pose."""
    action = jnp.array([0.0, 0.0, 0.0, 0.03, -0.02])
    plain = EnvConfig(lead=2.0, velocity_feedforward=False)
    for config, base in ((plain, 1.0), (EnvConfig(feedforward=False), 0.0)):
        env = _frozen(who, tiny.walking(), True, config)
        at_phase, _ = motion.sample(who.layout, walk, jnp.float32(5.0))
        ahead, _ = motion.sample(who.layout, walk, jnp.float32(5.0 + config.lead))
        state, _ = jit(env.step)(_put(np.asarray(at_phase), 5.0), action)
        wanted = base * np.asarray(ahead[-2:]) + np.array([0.03, -0.02])
        np.testing.assert_allclose(state.sim.qacc[-2:], wanted, atol=1e-5)


# Ends


@pytest.mark.parametrize(
    ("moved", "name"),
    [
        ({"d0": 0.31}, "com_x"),
        ({"d1": -0.31}, "com_y"),
        ({"d2": 0.21}, "com_z"),
        ({"d5": 0.71}, "root"),
        ({"d8": 0.71}, "spine"),
        ({"d9": 0.71}, "left_hip"),
        ({"d2": 0.4, "d9": 0.75}, "com_z"),  # twice its size, against 1.07 times
        ({"d2": 0.21, "d10": -0.9}, "right_hip"),
    ],
)
def test_a_bound_ends_an_episode_under_its_name(
    who: Character, stand: Running, moved: dict, name: str
):
    state = _put(_displaced(who, **({"d2": 0.0} | moved)) + np.eye(13)[2] * 0.05)
    assert _after(stand, state) == (True, False, name)
    _, outcome = stand.step(state, STILL)
    assert float(outcome.spike) == 0.0
    assert not bool(outcome.report.inside)


def test_just_inside_nothing_ends(who: Character, stand: Running):
    moved = {"d0": 0.2, "d1": 0.2, "d2": 0.2, "d5": 0.69, "d8": 0.69, "d9": 0.69}
    _, outcome = stand.step(_put(_displaced(who, **moved)), STILL)
    assert (bool(outcome.terminated), bool(outcome.truncated)) == (False, False)
    assert float(outcome.spike) == 1.0
    assert bool(outcome.report.inside)


def test_ground_contact_of_a_forbidden_body_alone_ends_an_episode(who: Character, stand: Running):
    """Well inside the bounds: lowered onto the left foot, onto the right one, and above both."""
    left, right, above = {"d2": -0.01, "d3": -0.4}, {"d2": -0.01, "d3": 0.4}, {"d2": 0.02}
    assert _after(stand, _put(_displaced(who, **left))) == (True, False, "ground contact")
    assert _after(stand, _put(_displaced(who, **right)))[:2] == (False, False)
    assert _after(stand, _put(_displaced(who, **above)))[:2] == (False, False)


@pytest.mark.parametrize(
    ("moved", "fallen"),
    [
        ({}, False),
        ({"d0": 5.0, "d9": 2.0}, False),  # far outside the bounds
        ({"d2": -0.1}, False),  # legs may touch
        ({"d2": -0.46}, True),  # the pelvis on the floor
        ({"d4": np.pi, "d2": -0.2}, True),  # on its head
    ],
)
def test_in_fall_mode_only_a_fall_ends_an_episode(
    who: Character, faller: Running, moved: dict, fallen: bool
):
    _, outcome = faller.step(_put(_displaced(who, **moved)), STILL)
    assert (bool(outcome.terminated), bool(outcome.truncated)) == (fallen, False)
    assert bool(outcome.report.fallen) == fallen
    if fallen:
        assert faller.env.endings[int(outcome.report.ended_by)] == "fall"


@pytest.mark.parametrize(
    ("moved", "end"),
    [
        ({"d2": -0.1}, ""),
        ({"d9": 2.0}, ""),
        ({"d2": -0.46}, "fall"),  # the pelvis on the floor, inside the bounds
        ({"d0": 1.0}, "com_x"),  # upright
        ({"d0": 1.0, "d2": -0.46}, "com_x"),
    ],
)
def test_bounds_and_falls_both_end_an_episode(
    who: Character, careful: Running, moved: dict, end: str
):
    ended, _, by = _after(careful, _put(_displaced(who, **moved)))
    assert (ended, by if ended else "") == (bool(end), end)


@pytest.mark.parametrize(
    ("moved", "lost"),
    [({}, False), ({"d2": -0.1}, False), ({"d0": 5.0}, True), ({"d9": 2.0}, True)],
)
def test_who_may_lie_on_the_ground_falls_by_leaving_the_bounds(
    who: Character, roller: Running, moved: dict, lost: bool
):
    _, outcome = roller.step(_put(_displaced(who, **moved)), STILL)
    assert bool(outcome.report.fallen) == bool(outcome.terminated) == lost


def test_the_time_limit_cuts_off_and_does_not_terminate(
    who: Character, stand: Running, faller: Running
):
    above = _displaced(who, d2=0.05)
    for running in (stand, faller):
        assert _after(running, _put(above, 7.0, LIMIT - 2))[:2] == (False, False)
        assert _after(running, _put(above, 7.0, LIMIT - 1)) == (False, True, "time limit")
    _, outcome = stand.step(_put(above, 7.0, LIMIT - 1), STILL)
    assert float(outcome.spike) == 1.0
    # Out of bounds in the last step: that ends it.
    away = _displaced(who, d0=1.0, d2=0.05)
    assert _after(stand, _put(away, 7.0, LIMIT - 1)) == (True, False, "com_x")


def test_a_motion_without_loop_is_held_for_half_a_second_and_cut_off(who: Character, once: Running):
    held = _displaced(who, d2=0.3)
    assert once.env.length == pytest.approx(30.0)
    for phase, over in ((29.5, False), (43.5, False), (44.0, True), (50.0, True)):
        assert _after(once, _put(held, phase))[:2] == (False, over)
    assert _after(once, _put(held, 44.0))[2] == "time limit"


def test_the_bounds_of_a_held_pose_are_those_of_the_end(who: Character, once: Running):
    """Sizes over phase go from the first pose to the last; a held last pose keeps the last."""
    for phase in (28.9, 29.0, 35.0):
        _, outcome = once.step(_put(_displaced(who, d2=0.3), phase), STILL)
        np.testing.assert_allclose(outcome.report.sizes[0], 0.5, rtol=0.01)


@pytest.mark.parametrize("what", ["action", "position", "velocity", "huge velocity"])
def test_a_simulation_that_blows_up_ends_the_episode_and_says_so(walker: Running, what: str):
    state, action = walker.start(jnp.float32(0.0)), STILL
    if what == "action":
        action = _push(2, np.nan)
    else:
        field = "qpos" if what == "position" else "qvel"
        broken = getattr(state.sim, field).at[7].set(1e9 if "huge" in what else jnp.nan)
        state = dataclasses.replace(state, sim=dataclasses.replace(state.sim, **{field: broken}))
    after, outcome = walker.step(state, action)
    assert (bool(outcome.terminated), bool(outcome.truncated)) == (True, False)
    assert walker.env.endings[int(outcome.report.ended_by)] == "diverged"
    assert float(outcome.spike) == 0.0
    assert not bool(outcome.report.inside)
    assert np.isfinite(after.sim.qpos).all()
    assert np.isfinite(outcome.obs).all()


def test_a_blow_up_also_ends_an_episode_in_fall_mode(who: Character, faller: Running):
    state = _put(_displaced(who), diverged=True)
    assert _after(faller, state) == (True, False, "diverged")


@pytest.mark.parametrize(
    ("line", "instead"),
    [
        ('ground = ["left_leg"', 'ground = ["pelvis", "torso", "left_leg"'),
        ('end_effectors = ["torso", "left_leg", "right_leg"]', "end_effectors = []"),
    ],
    ids=["all may touch the ground", "no end effectors"],
)
def test_unusual_characters_step_too(tmp_path: Path, line: str, instead: str):
    toml = tiny.write_character(tmp_path).with_suffix(".toml")
    assert line in toml.read_text()
    toml.write_text(toml.read_text().replace(line, instead))
    odd = character.load(str(toml.with_suffix(".xml")))
    env = _frozen(odd, tiny.standing(), True, EnvConfig(reward="imitation"))
    state = jax.eval_shape(env.start, jnp.float32(0.0))
    _, outcome = jax.eval_shape(env.step, state, STILL)
    assert outcome.report.errors.shape == (7 + len(odd.end_effectors),)


# Rewards


def test_the_imitation_reward_is_one_on_the_reference_and_less_beside_it(
    who: Character, faller: Running
):
    moved = [{}, {"d8": 0.1}, {"d8": 0.3}, {"d8": 0.6}, {"d2": -0.46}]
    worth = [float(faller.step(_put(_displaced(who, **d)), STILL)[1].spike) for d in moved]
    assert worth[0] == pytest.approx(1.0, abs=1e-5)
    assert 1.0 > worth[1] > worth[2] > worth[3] > 0.0
    assert worth[4] == 0.0  # fallen


# Servos


def test_without_limits_servos_have_any_strength(who: Character, walk: Motion):
    """Pushes by 2 and 3 rad, at a hip of 80 N m/rad that is limited to 40 N m."""
    largest, swung = [], []
    for limited in (True, False):
        made = _running(tiny.make_env(who, walk, EnvConfig(torque_limits=limited)))
        _, outcome = made.step(made.start(jnp.float32(3.0)), _push(3, 2.0))
        largest.append(np.abs(np.asarray(outcome.report.torque)).max())
        state, _ = made.step(made.start(jnp.float32(3.0)), _push(3, 3.0))
        swung.append(float(state.sim.qpos[tiny.LEFT_HIP]))
    assert largest[0] <= 40.0 * (1 + 1e-4)
    assert swung[1] > 1.5 * swung[0] > 0.0
    servos = servo.of(who)
    assert (servo.unlimited(servos).torque == jnp.inf).all()
    assert servo.unlimited(servos).kp is servos.kp


def test_a_step_is_a_thirtieth_of_a_second_under_pd_with_clipped_torques(
    who: Character, walk: Motion, walker: Running
):
    """Against C MuJoCo by hand: kp (target - q) + kd (speed - v), by MuJoCo's own difference.

    q and v are those at the end of a step, as far as the acceleration of the one before tells.
    """
    state = walker.start(jnp.float32(0.0))
    turned, action = np.array(state.sim.qpos, float), np.array([0.9, -0.6, 0.3, 0.6, -0.5])
    mujoco.mj_integratePos(who.model, turned, np.array([0.0] * 6 + [1.2, 0.8, -0.9, 0, 0]), 1.0)
    state = dataclasses.replace(
        state, sim=dataclasses.replace(state.sim, qpos=jnp.asarray(turned, jnp.float32))
    )
    model = character.compile(who, CONTROL_DT / 4)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.sim.qpos, state.sim.qvel
    base, speed = motion.sample(who.layout, walk, jnp.float32(EnvConfig().lead))
    target = np.array(base, float)
    mujoco.mj_integratePos(model, target, np.concatenate((np.zeros(6), action)), 1.0)
    clipped, vector = [], np.zeros(3)
    for _ in range(4):
        error = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, error, 1.0, data.qpos, target)
        end = (data.qvel + data.qacc * CONTROL_DT / 4)[6:]
        error = error[6:] - end * CONTROL_DT / 4
        torque = who.kp * error + who.kd * (np.asarray(speed)[6:] - end)
        clipped.append(np.abs(torque) > who.torque)
        torque = np.clip(torque, -who.torque, who.torque)
        mujoco.mju_quat2Vel(vector, data.qpos[tiny.SPINE], 1.0)
        now = np.concatenate((vector, data.qpos[tiny.LEFT_HIP :]))
        data.ctrl[:] = now + end * CONTROL_DT / 4 + (torque + who.kd * end) / who.kp
        mujoco.mj_step(model, data)
    assert 0.1 < np.mean(clipped) < 0.9
    after, _ = walker.step(state, jnp.asarray(action, jnp.float32))
    assert data.time == pytest.approx(CONTROL_DT)
    np.testing.assert_allclose(after.sim.qpos, data.qpos, atol=1e-4)
    np.testing.assert_allclose(after.sim.qvel, data.qvel, atol=2e-2)


def test_light_limbs_speed_up_beyond_torque_over_damping(who: Character, walker: Running):
    """A leg swings in the air. A set point held for a control step would stop it at that speed."""
    state, push = walker.start(jnp.float32(0.0)), _push(3, 2.0)
    sim = dataclasses.replace(state.sim, qpos=state.sim.qpos.at[2].add(1.0), qvel=jnp.zeros(11))
    state = dataclasses.replace(state, sim=sim)
    limit = float((who.torque / who.kd)[3])  # 5 rad/s
    assert float(walker.step(state, push)[0].sim.qvel[9]) > limit


def test_the_report_says_which_torque_was_applied(walker: Running):
    _, outcome = walker.step(walker.start(jnp.float32(0.0)), _push(3, 0.3))
    assert outcome.report.torque.shape == (5,)
    assert abs(float(outcome.report.torque[3])) > 1.0


# Settings


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EnvConfig(substeps=0), "env.substeps is 0: give 1 to 100 (20 is 600 Hz)"),
        (EnvConfig(substeps=101), "env.substeps is 101: give 1 to 100 (20 is 600 Hz)"),
        (EnvConfig(seconds=0.0), "env.seconds is 0.0: give 1/30 to 3600 s"),
        (EnvConfig(seconds=float("nan")), "env.seconds is nan: give 1/30 to 3600 s"),
        (EnvConfig(hold=1.0), "env.hold is 1.0: give 3 to 3000 control frames"),
        (EnvConfig(lead=31.0), "env.lead is 31.0: give -30 to 30 control frames"),
    ],
)
def test_what_is_out_of_range_is_refused(config: EnvConfig, message: str):
    with pytest.raises(UserError) as raised:
        core.validate(config)
    assert str(raised.value) == message
