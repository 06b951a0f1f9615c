# SPDX-License-Identifier: Apache-2.0
"""The environment: starts, steps, every way an episode ends, and what the servos are told."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character, ground, kinematics, motion, pose
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, core
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig, EnvState, Outcome
from jaxskills.errors import UserError
from jaxskills.motion import CONTROL_DT
from jaxskills.physics import Physics, SimState, servo

STILL = jnp.zeros(5)  # the action that changes nothing


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("character"))


@pytest.fixture(scope="module")
def walker(who: Character) -> tuple[core.Environment, Callable]:
    """The walk on the real engine, and its compiled step."""
    env = tiny.make_env(who, tiny.make_motion(who, tiny.walking(), True))
    return env, jit(env.step)


def _frozen() -> Physics:
    """Returns an engine in which nothing ever moves: states can be set by hand."""
    sim = lambda qpos, qvel: SimState(qpos, qvel, jnp.zeros(11), jnp.bool_(False))  # noqa: E731
    return Physics(
        load=lambda models: None,
        init=lambda model, variant, qpos, qvel: sim(qpos, qvel),
        step=lambda model, variant, state, ctrl: state,
    )


def _frozen_env(
    who: Character,
    qpos: np.ndarray,
    loop: bool,
    config: EnvConfig,
    sizes: BoundsConfig = BoundsConfig(),  # noqa: B008  frozen
) -> core.Environment:
    reference = tiny.make_motion(who, qpos, loop)
    return core.make(who, reference, _frozen(), None, bounds.make(who, sizes), config)


def _put(qpos: np.ndarray, phase: float = 0.0, step: int = 0) -> EnvState:
    """Returns a state by hand, at rest."""
    sim = SimState(jnp.asarray(qpos, jnp.float32), jnp.zeros(11), jnp.zeros(11), jnp.bool_(False))
    return EnvState(sim, jnp.float32(phase), jnp.int32(step), jnp.int32(0))


def _lowest(who: Character, qpos: jax.Array) -> float:
    tree, params = kinematics.tree(who.model), kinematics.body_params(who.model)
    bodies = kinematics.kinematics(tree, params, qpos, jnp.zeros(who.layout.nv))
    return float(jnp.min(ground.clearance(ground.shapes(who.model), bodies)))


def _ended_by(env: core.Environment, outcome: Outcome) -> str:
    return env.endings[int(outcome.report.ended_by)]


def _flags(outcome: Outcome) -> tuple[bool, bool]:
    return bool(outcome.terminated), bool(outcome.truncated)


# Starts


@pytest.mark.parametrize("phase", [0.0, 4.5, 100.25])
def test_a_start_is_the_reference(who: Character, walker, phase: float):
    env, _ = walker
    reference = tiny.make_motion(who, tiny.walking(), True)
    qpos, qvel = motion.sample(who.layout, reference, jnp.float32(phase))
    state = env.start(jnp.float32(phase))
    np.testing.assert_allclose(np.delete(state.sim.qpos, 2), np.delete(qpos, 2), atol=1e-6)
    np.testing.assert_allclose(state.sim.qvel, qvel, atol=1e-6)
    assert (float(state.phase), int(state.step)) == (phase, 0)
    assert not bool(state.sim.diverged)


@pytest.mark.parametrize(("height", "expected"), [(0.4, 0.501), (0.5, 0.501), (0.8, 0.8)])
def test_a_start_is_lifted_out_of_the_floor_and_no_further(
    who: Character, height: float, expected: float
):
    qpos = tiny.standing()
    qpos[:, 2] = height
    state = _frozen_env(who, qpos, True, EnvConfig()).start(jnp.float32(2.0))
    np.testing.assert_allclose(state.sim.qpos[2], expected, atol=1e-5)


def test_tilted_legs_are_lifted_out_of_the_floor_too(who: Character):
    qpos = tiny.standing()
    qpos[:, tiny.LEFT_HIP] = 0.3
    state = _frozen_env(who, qpos, True, EnvConfig()).start(jnp.float32(0.0))
    assert _lowest(who, state.sim.qpos) == pytest.approx(1e-3, abs=1e-5)


# Steps


def test_a_step_goes_one_control_frame_on(walker):
    env, step = walker
    state = env.start(jnp.float32(3.25))
    for count in range(1, 4):
        state, outcome = step(state, STILL)
        assert (float(state.phase), int(state.step)) == (3.25 + count, count)
        assert _flags(outcome) == (False, False)
        assert (float(outcome.spike), float(outcome.rate), float(outcome.dphase)) == (1.0, 0.0, 1.0)
        assert bool(outcome.report.inside)
        np.testing.assert_allclose(outcome.obs, env.observe(state), atol=1e-5)


def test_a_step_is_a_thirtieth_of_a_second_of_the_engine(who: Character, walker):
    """Against C MuJoCo stepped by hand under the same controls."""
    env, step = walker
    state = env.start(jnp.float32(0.0))
    model = character.compile(who, CONTROL_DT / 4)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = state.sim.qpos, state.sim.qvel
    reference = tiny.make_motion(who, tiny.walking(), True)
    action = np.array([0.1, -0.2, 0.1, 0.3, -0.1])
    target, _ = motion.sample(who.layout, reference, jnp.float32(EnvConfig().lead))
    target = pose.plus(who.layout, target, jnp.concatenate((jnp.zeros(6), jnp.asarray(action))))
    data.ctrl[:] = servo.set_point(
        servo.of(who), who.layout, state.sim.qpos, state.sim.qvel, target
    )
    mujoco.mj_step(model, data, 4)
    after, _ = step(state, jnp.asarray(action))
    np.testing.assert_allclose(after.sim.qpos, data.qpos, atol=1e-5)
    np.testing.assert_allclose(after.sim.qvel, data.qvel, atol=1e-3)


def test_the_same_inputs_give_the_same_bits(walker):
    env, _ = walker
    phases = jnp.array([0.0, 7.0, 11.5])
    actions = 0.2 * jax.random.normal(jax.random.key(0), (6, 3, 5))
    batched = jit(jax.vmap(env.step))

    def run() -> list:
        state, rows = jax.vmap(env.start)(phases), []
        for action in actions:
            state, outcome = batched(state, action)
            rows.append(jax.tree.map(np.asarray, (state, outcome)))
        return rows

    jax.tree.map(np.testing.assert_array_equal, run(), run())


def test_an_action_moves_the_joint_it_names(walker):
    """Actions are in the order of the servos: three of the spine, left hip, right hip."""
    env, step = walker
    assert env.action_size == 5
    for index, qpos in ((0, 8), (1, 9), (2, 10), (3, tiny.LEFT_HIP), (4, tiny.RIGHT_HIP)):
        ends = [step(env.start(jnp.float32(0.0)), STILL.at[index].set(s))[0] for s in (0.4, -0.4)]
        change = np.abs(ends[0].sim.qpos - ends[1].sim.qpos)[7:]
        assert change.argmax() == qpos - 7
        assert ends[0].sim.qpos[qpos] > ends[1].sim.qpos[qpos]


def test_without_feedforward_targets_are_displacements_from_the_zero_pose(who: Character):
    qpos = tiny.standing()
    qpos[:, 2], qpos[:, tiny.LEFT_HIP] = 0.8, 0.6
    ends = []
    for feedforward in (True, False):
        config = EnvConfig(feedforward=feedforward)
        env = tiny.make_env(who, tiny.make_motion(who, qpos, True), config)
        ends.append(float(env.step(env.start(jnp.float32(0.0)), STILL)[0].sim.qpos[11]))
    assert ends[0] == pytest.approx(0.6, abs=0.02)
    assert ends[1] < 0.55


# Ends


@pytest.fixture(scope="module")
def guarded(who: Character) -> tuple[core.Environment, Callable]:
    """A frozen stand in which the torso must not touch the ground."""
    sizes = BoundsConfig(no_ground_contact=("torso",))
    env = _frozen_env(who, tiny.standing(), True, EnvConfig(), sizes)
    return env, jit(env.step)


def _displaced(who: Character, **by_dof: float) -> np.ndarray:
    d = np.zeros(who.layout.nv)
    for name, value in by_dof.items():
        d[int(name[1:])] = value
    qpos = tiny.standing(1)[0]
    mujoco.mj_integratePos(who.model, qpos, d, 1.0)
    return qpos


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
def test_a_bound_ends_an_episode_under_its_name(who: Character, guarded, moved: dict, name: str):
    env, step = guarded
    _, outcome = step(_put(_displaced(who, **moved)), STILL)
    assert _flags(outcome) == (True, False)
    assert _ended_by(env, outcome) == name
    assert float(outcome.spike) == 0.0
    assert not bool(outcome.report.inside)


def test_just_inside_nothing_ends(who: Character, guarded):
    _, step = guarded
    moved = {"d0": 0.2, "d1": 0.2, "d2": 0.15, "d5": 0.69, "d8": 0.69, "d9": 0.69}
    _, outcome = step(_put(_displaced(who, **moved)), STILL)
    assert _flags(outcome) == (False, False)
    assert float(outcome.spike) == 1.0
    assert bool(outcome.report.inside)


def test_ground_contact_of_a_forbidden_body_alone_ends_an_episode(who: Character):
    """The torso bends down to the floor; with loose bounds only the contact can end it."""
    sizes = BoundsConfig((9.0,) * 3, 9.0, 9.0, 9.0, no_ground_contact=("torso",))
    low = _displaced(who, d2=-0.35, d7=3.0)
    env = _frozen_env(who, tiny.standing(), True, EnvConfig(), sizes)
    _, outcome = jit(env.step)(_put(low), STILL)
    assert _flags(outcome) == (True, False)
    assert _ended_by(env, outcome) == "ground contact"
    assert not bool(outcome.report.inside)
    # Feet in the floor are no such contact.
    _, outcome = jit(env.step)(_put(_displaced(who, d2=-0.1)), STILL)
    assert _flags(outcome) == (False, False)


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
def test_in_fall_mode_only_a_fall_ends_an_episode(who: Character, falling, moved, fallen: bool):
    env, step = falling
    _, outcome = step(_put(_displaced(who, **moved)), STILL)
    assert _flags(outcome) == (fallen, False)
    assert bool(outcome.report.fallen) == fallen
    if fallen:
        assert _ended_by(env, outcome) == "fall"


@pytest.fixture(scope="module")
def falling(who: Character) -> tuple[core.Environment, Callable]:
    env = _frozen_env(who, tiny.standing(), True, EnvConfig(stop="fall"))
    return env, jit(env.step)


@pytest.mark.parametrize("stop", ["bounds", "fall"])
def test_the_time_limit_cuts_off_and_does_not_terminate(who: Character, stop):
    env = _frozen_env(who, tiny.standing(), True, EnvConfig(seconds=0.2, stop=stop))
    step, state = jit(env.step), env.start(jnp.float32(2.0))
    for count in range(1, 7):
        state, outcome = step(state, STILL)
        assert _flags(outcome) == (False, count == 6)
        assert float(outcome.spike) == 1.0
    assert _ended_by(env, outcome) == "time limit"


def test_a_bound_left_at_the_time_limit_terminates(who: Character):
    env = _frozen_env(who, tiny.standing(), True, EnvConfig(seconds=0.2))
    _, outcome = env.step(_put(_displaced(who, d0=1.0), step=5), STILL)
    assert _flags(outcome) == (True, False)
    assert _ended_by(env, outcome) == "com_x"


def test_a_motion_without_loop_is_held_for_half_a_second_and_cut_off(who: Character):
    env = _frozen_env(who, tiny.standing(), False, EnvConfig())
    step = jit(env.step)
    assert env.length == pytest.approx(30.0)
    for phase, over in ((29.5, False), (43.5, False), (44.0, True), (50.0, True)):
        _, outcome = step(_put(tiny.standing(1)[0], phase), STILL)
        assert _flags(outcome) == (False, over)
        assert float(outcome.spike) == 1.0
    assert _ended_by(env, outcome) == "time limit"


def test_the_bounds_of_a_held_pose_are_those_of_the_end(who: Character):
    """Sizes over phase go from the first pose to the last; a held last pose keeps the last."""
    sizes = BoundsConfig(channels={"com_x": (0.1, 0.5)})
    env = _frozen_env(who, tiny.standing(), False, EnvConfig(), sizes)
    step = jit(env.step)
    for phase in (28.9, 29.0, 35.0):
        _, outcome = step(_put(tiny.standing(1)[0], phase), STILL)
        np.testing.assert_allclose(outcome.report.sizes[0], 0.5, rtol=0.01)


@pytest.mark.parametrize(
    ("line", "instead"),
    [
        (
            'ground = ["left_leg", "right_leg"]',
            'ground = ["pelvis", "torso", "left_leg", "right_leg"]',
        ),
        ('end_effectors = ["torso", "left_leg", "right_leg"]', "end_effectors = []"),
    ],
    ids=["all may touch the ground", "no end effectors"],
)
def test_unusual_characters_step_too(tmp_path: Path, line: str, instead: str):
    toml = tiny.write_character(tmp_path).with_suffix(".toml")
    assert line in toml.read_text()
    toml.write_text(toml.read_text().replace(line, instead))
    odd = character.load(str(toml.with_suffix(".xml")))
    env = _frozen_env(odd, tiny.standing(), True, EnvConfig(reward="imitation"))
    _, outcome = jit(env.step)(_put(tiny.standing(1)[0]), STILL)
    assert _flags(outcome) == (False, False)
    assert float(outcome.spike) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("what", ["action", "position", "velocity", "huge velocity"])
def test_a_simulation_that_blows_up_ends_the_episode_and_says_so(walker, what: str):
    env, step = walker
    state, action = env.start(jnp.float32(0.0)), STILL
    if what == "action":
        action = action.at[2].set(jnp.nan)
    else:
        field = "qpos" if what == "position" else "qvel"
        broken = getattr(state.sim, field).at[7].set(1e9 if "huge" in what else jnp.nan)
        state = dataclasses.replace(state, sim=dataclasses.replace(state.sim, **{field: broken}))
    after, outcome = step(state, action)
    assert _flags(outcome) == (True, False)
    assert _ended_by(env, outcome) == "diverged"
    assert float(outcome.spike) == 0.0
    assert not bool(outcome.report.inside)
    assert np.isfinite(after.sim.qpos).all()
    assert np.isfinite(outcome.obs).all()


def test_a_blow_up_also_ends_an_episode_in_fall_mode(who: Character):
    env = tiny.make_env(who, tiny.make_motion(who, tiny.walking(), True), EnvConfig(stop="fall"))
    _, outcome = jit(env.step)(env.start(jnp.float32(0.0)), STILL.at[0].set(jnp.inf))
    assert _flags(outcome) == (True, False)
    assert _ended_by(env, outcome) == "diverged"


# Rewards


def test_the_imitation_reward_is_one_on_the_reference_and_less_beside_it(who: Character):
    env = _frozen_env(who, tiny.standing(), True, EnvConfig(reward="imitation"))
    step = jit(env.step)
    _, outcome = step(_put(tiny.standing(1)[0]), STILL)
    assert float(outcome.spike) == pytest.approx(1.0, abs=1e-5)
    worth = [float(step(_put(_displaced(who, d8=x)), STILL)[1].spike) for x in (0.1, 0.3, 0.6)]
    assert 1.0 > worth[0] > worth[1] > worth[2] > 0.0
    _, outcome = step(_put(_displaced(who, d8=0.8)), STILL)
    assert float(outcome.spike) == 0.0  # out of bounds


# Servos


def _random_states(who: Character, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns poses, velocities and targets, some far and fast."""
    rng = np.random.default_rng(0)
    rows = np.tile(tiny.standing(1)[0], (2, count, 1))
    for row in rows.reshape(-1, 13):
        mujoco.mj_integratePos(who.model, row, rng.normal(0, 0.5, who.layout.nv), 1.0)
    return rows[0], rng.normal(0, 6.0, (count, who.layout.nv)), rows[1]


def test_the_torque_at_the_start_of_a_step_is_within_its_limits(who: Character):
    servos, layout = servo.of(who), who.layout
    qpos, qvel, target = (jnp.asarray(x, jnp.float32) for x in _random_states(who, 200))
    ctrl = jax.vmap(lambda *x: servo.set_point(servos, layout, *x))(qpos, qvel, target)
    torque = jax.vmap(lambda *x: servo.applied_torque(servos, layout, *x))(qpos, qvel, ctrl)
    assert (np.abs(torque) <= np.asarray(servos.torque) * (1 + 1e-4)).all()
    # Where the limit does not bind, the set point is the target.
    wanted = pose.rotation_vectors(layout, target)[:, np.array(servos.dofs)]
    free = np.abs(torque) < np.asarray(servos.torque) * (1 - 1e-3)
    assert 0.05 < free.mean() < 0.95
    np.testing.assert_allclose(np.asarray(ctrl)[free], np.asarray(wanted)[free], atol=1e-5)


def test_the_reported_torque_is_the_engines_without_its_implicit_part(who: Character):
    timestep = CONTROL_DT / 4
    model = character.compile(who, timestep)
    data = mujoco.MjData(model)
    servos = servo.of(who)
    for qpos, qvel, target in zip(*_random_states(who, 5), strict=True):
        now = [jnp.asarray(x, jnp.float32) for x in (qpos, qvel)]
        ctrl = servo.set_point(servos, who.layout, *now, jnp.asarray(target, jnp.float32))
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(model, data)
        found = servo.applied_torque(servos, who.layout, *now, ctrl)
        implicit = timestep * who.kp * data.actuator_velocity
        np.testing.assert_allclose(found, data.actuator_force + implicit, atol=2e-3)


def test_the_report_says_which_torque_was_applied(walker):
    env, step = walker
    _, outcome = step(env.start(jnp.float32(0.0)), STILL.at[3].set(0.3))
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
        (EnvConfig(lead=31.0), "env.lead is 31.0: give -30 to 30 control frames"),
    ],
)
def test_what_is_out_of_range_is_refused(config: EnvConfig, message: str):
    with pytest.raises(UserError) as raised:
        core.validate(config)
    assert str(raised.value) == message
