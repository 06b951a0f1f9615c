# SPDX-License-Identifier: Apache-2.0
"""Objects are carried along and change nothing of the character's own."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character as character_lib
from jaxskills import (
    evaluate,
    ground,
    kinematics,
    motion,
    objects,
    pose,
    trace,
    trainer,
    variation,
)
from jaxskills.character import Character, Object
from jaxskills.compilation import jit
from jaxskills.env import bounds, rewards
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig
from jaxskills.env.style import StyleConfig
from jaxskills.errors import UserError
from jaxskills.evaluate import EvaluateConfig
from jaxskills.explore import fitness
from jaxskills.motion import Motion

SLIDE, FREE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE
PATH = np.linspace(0.0, 0.6, 31) ** 2  # m


def _block(spec: mujoco.MjSpec) -> None:
    """40 kg, 2 m to the left, that slides along x and stands turned by a quarter."""
    turned = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    body = spec.worldbody.add_body(name="block", pos=[0.0, 2.0, 0.3], quat=turned)
    body.add_joint(name="block", type=SLIDE, axis=[0.0, -1.0, 0.0])
    body.add_geom(size=[0.3, 0.3, 0.3], type=mujoco.mjtGeom.mjGEOM_BOX, mass=40.0, contype=0)


def _ball(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name="ball", pos=[0.0, 0.0, -3.0], gravcomp=1.0)
    for name, axis in zip("xyz", np.eye(3), strict=True):
        body.add_joint(name=f"ball_{name}", type=SLIDE, axis=axis)
    body.add_geom(size=[0.1, 0.0, 0.0], mass=7.0, contype=0, conaffinity=0)


BLOCK = Object("block", _block, path=lambda who, shown: PATH[:, None])
BALL = Object("ball", _ball)


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


@pytest.fixture(scope="module")
def walk(who: Character) -> Motion:
    return tiny.make_motion(who, tiny.walking(), False)


@pytest.fixture(scope="module")
def both(who: Character, walk: Motion) -> tuple[Character, Motion]:
    return objects.add(who, walk, [BLOCK, BALL])


def _random(who: Character, seed: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    qpos = who.model.qpos0.copy()
    mujoco.mj_integratePos(who.model, qpos, random.normal(size=who.model.nv), 1.0)
    return qpos, random.normal(size=who.model.nv)


def test_an_object_comes_after_the_character(who: Character, both: tuple[Character, Motion]):
    whole, shown = both
    assert [joint.name for joint in whole.layout.joints[-4:]] == [
        "block",
        "ball_x",
        "ball_y",
        "ball_z",
    ]
    assert whole.layout.own == who.layout
    assert (whole.body_names, whole.mass) == (who.body_names, who.mass)
    assert whole.model.nu == who.model.nu
    np.testing.assert_allclose(shown.qpos[:, 13], PATH, atol=1e-6)
    np.testing.assert_allclose(shown.qpos[:, 14:], 0.0)
    np.testing.assert_allclose(shown.qvel[1:-1, 11], 15 * (PATH[2:] - PATH[:-2]), atol=1e-5)


def test_places_are_those_of_mujoco(both: tuple[Character, Motion]):
    whole = both[0]
    qpos, qvel = _random(whole, 1)
    data = mujoco.MjData(whole.model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(whole.model, data)
    for name in ("block", "ball"):
        at, body = objects.place(whole, name), data.body(name)
        speed = np.zeros(6)
        which = mujoco.mjtObj.mjOBJ_BODY, body.id
        mujoco.mj_objectVelocity(whole.model, data, *which, speed, 0)
        here = objects.position(at, jnp.asarray(qpos, jnp.float32))
        np.testing.assert_allclose(here, body.xpos, atol=1e-5)
        moved = objects.velocity(at, jnp.asarray(qvel, jnp.float32))
        np.testing.assert_allclose(moved, speed[3:], atol=1e-5)
    assert (objects.place(whole, "block").mass, objects.place(whole, "ball").mass) == (40.0, 7.0)


def test_sums_over_bodies_leave_objects_out(who: Character, both: tuple[Character, Motion]):
    whole = both[0]
    qpos, qvel = _random(whole, 2)
    found = []
    for one, model in ((who, who.model), (whole, whole.model)):
        tree, params = kinematics.tree(model), kinematics.body_params(model)
        q, v = (jnp.asarray(x, jnp.float32) for x in (qpos[: model.nq], qvel[: model.nv]))
        bodies = kinematics.kinematics(tree, params, q, v)
        found.append(
            (
                bodies,
                *kinematics.momentum(params, bodies),
                kinematics.kinetic_energy(params, bodies),
                ground.clearance(ground.shapes(model), bodies),
                rewards.imitation_weights(one),
            )
        )
    _equal(*found)
    data = mujoco.MjData(whole.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(whole.model, data)
    mujoco.mj_comPos(whole.model, data)
    np.testing.assert_allclose(found[1][0].com, data.subtree_com[1], atol=1e-5)


def _equal(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


def _play(who: Character, shown: Motion, config: EnvConfig, sizes: BoundsConfig, act: np.ndarray):
    """Returns what steps along `act [T, A]` gave, and the observation they began with."""
    env = tiny.make_env(who, shown, config, sizes)
    state = jit(env.start)(jnp.float32(3.0))
    step, seen = jit(env.step), []
    first = jit(env.observe)(state)
    for action in act:
        state, outcome = step(state, jnp.asarray(action, jnp.float32))
        seen.append((state, outcome))
    return env, first, seen


WIDE = BoundsConfig(com=(9.0, 9.0, 9.0), root=9.0, joints=9.0, end_effectors=9.0)


@pytest.mark.parametrize(
    "config",
    [
        EnvConfig(reward="blend", style=StyleConfig(style="energy_up", energy=(0.0, 1.0))),
        EnvConfig(reward="tracking"),
    ],
    ids=["blend", "tracking"],
)
def test_an_environment_differs_only_in_what_is_added(
    who: Character, walk: Motion, both: tuple[Character, Motion], config: EnvConfig
):
    act = np.random.default_rng(3).normal(size=(4, 5)) * 0.2
    _, first, seen = _play(who, walk, config, WIDE, act)
    env, more, other = _play(*both, config, WIDE, act)
    count = len(first)
    # The block is seen with its place, speed and offset, the ball not at all.
    assert len(more) == count + 9 + 6
    np.testing.assert_allclose(more[:count], first, atol=1e-6)
    np.testing.assert_allclose(more[-6:], 0.0)
    assert float(jnp.abs(more[count : count + 6]).min()) < 2.1
    for (a, one), (b, two) in zip(seen, other, strict=True):
        np.testing.assert_allclose(b.sim.qpos[:13], a.sim.qpos, atol=1e-4)
        np.testing.assert_allclose(two.obs[:count], one.obs, atol=1e-2)
        for x, y in ((one.rate, two.rate), (one.spike, two.spike)):
            np.testing.assert_allclose(y, x, atol=1e-4)
        known = len(one.report.errors)
        np.testing.assert_allclose(two.report.errors[:known], one.report.errors, atol=1e-4)
        np.testing.assert_allclose(two.report.com, one.report.com, atol=1e-5)
        assert not bool(two.terminated)
    assert env.endings[known : known + 4] == ("block", "ball_x", "ball_y", "ball_z")
    assert max(float(one.rate + one.spike) for _, one in seen) > 0.1


def test_the_block_is_seen_from_the_root(both: tuple[Character, Motion]):
    """Turned by a quarter, the root sees what lies 2 m to its left straight ahead."""
    whole = both[0]
    scene = objects.scene(whole, 30.0)
    assert scene is not None
    qpos = whole.model.qpos0.copy()
    half = np.sqrt(0.5)
    qpos[:7] = 1.0, 0.0, 0.5, half, 0.0, 0.0, half
    qpos[13] = 0.4
    qvel, offset = np.zeros(15), np.zeros(15)
    qvel[11], offset[11] = 3.0, 0.1
    q, v, d = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, offset))
    tree, params = kinematics.tree(whole.model), kinematics.body_params(whole.model)
    bodies = kinematics.kinematics(tree, params, q, v)
    seen = scene.observe(q, v, d, bodies, jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(seen[:3], [2.0, 0.6, -0.2], atol=1e-6)
    np.testing.assert_allclose(seen[3:6], [0.0, -3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[6:9], [0.0, -0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(seen[9:], 0.0)
    seen = scene.observe(q.at[16].set(2.0), v, d, bodies, jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(seen[9:12], [0.0, 1.0, -1.5], atol=1e-6)


def test_bounds_of_objects_are_open_unless_named(who: Character, both: tuple[Character, Motion]):
    whole = both[0]
    names = bounds.channel_names(whole)
    own = len(bounds.channel_names(who))
    assert names[:own] == bounds.channel_names(who)
    assert names[own:] == ("block", "ball_x", "ball_y", "ball_z")
    assert bounds.channel_units(whole)[own:] == ("m",) * 4
    made = bounds.table(whole, BoundsConfig())[0]
    np.testing.assert_array_equal(made[:own], bounds.table(who, BoundsConfig())[0])
    np.testing.assert_array_equal(made[own:], bounds.OPEN)
    assert bounds.table(whole, BoundsConfig(channels={"block": 0.3}))[0, own] == 0.3


def test_a_named_bound_ends_the_episode(both: tuple[Character, Motion]):
    """Nothing pushes the block, which the reference moves."""
    sizes = dataclasses.replace(WIDE, channels={"block": 0.01})
    env, _, seen = _play(*both, EnvConfig(), sizes, np.zeros((6, 5)))
    ends = [bool(outcome.terminated) for _, outcome in seen]
    block = env.endings.index("block")
    errors = np.array([float(outcome.report.errors[block]) for _, outcome in seen])
    assert ends == list(errors > 0.01) and ends[-1]
    assert int(seen[-1][1].report.ended_by) == block


def test_fitness_does_not_look_at_objects(
    who: Character, walk: Motion, both: tuple[Character, Motion]
):
    found = []
    for one, shown, extra in ((who, walk, 0), (*both, 1)):
        judge = fitness.make(one, shown, fitness.FitnessConfig(velocity=10.0))
        qpos, qvel = np.array(shown.qpos), np.array(shown.qvel)
        qpos[:, 11] += 0.2  # the left leg
        if extra:
            qpos[:, 13:], qvel[:, 11:] = 5.0, -3.0
        found.append(judge(qpos, qvel, np.arange(31.0), np.ones(31, bool), jnp.float32(0.0)))
    _equal(*found)
    assert 0.0 < float(found[0].pose) < 0.9999


def test_variations_are_the_characters_own(
    who: Character, walk: Motion, both: tuple[Character, Motion]
):
    whole, shown = both
    random = np.random.default_rng(4)
    made = variation.Variation(jnp.asarray(random.normal(size=(4, 11)) * 0.1), jnp.zeros(4))
    small = variation.displace(who.layout, walk, made)
    large = variation.displace(whole.layout, shown, made)
    np.testing.assert_allclose(large.qpos[:, :13], small.qpos, atol=1e-6)
    np.testing.assert_allclose(large.qpos[:, 13:], shown.qpos[:, 13:], atol=1e-6)
    np.testing.assert_allclose(large.qvel[:, :11], small.qvel, atol=1e-5)
    np.testing.assert_allclose(large.qvel[:, 11:], shown.qvel[:, 11:], atol=1e-5)
    rows = jnp.arange(31.0), jnp.zeros(31), jnp.ones(31, bool)
    astray = large.qpos.at[:, 13:].add(3.0)
    before, _ = trace.trace_to_variation(who.layout, walk, small.qpos, *rows, 4)
    after, covered = trace.trace_to_variation(whole.layout.own, shown, astray, *rows, 4)
    assert after.d.shape == (4, 11) and float(covered) == 1.0
    np.testing.assert_allclose(after.d, before.d, atol=1e-6)


def test_drift_is_kept_where_there_are_objects(both: tuple[Character, Motion]):
    whole, shown = both
    qpos = shown.qpos[7].at[:2].add(0.25)
    back, _, phase = motion.fold(whole.layout, shown, qpos, shown.qvel[7], jnp.float32(7.0))
    np.testing.assert_allclose(back, qpos, atol=1e-6)
    assert float(phase) == 7.0


def test_a_users_file_may_hold_objects(who: Character, tmp_path: Path):
    """What stands or rolls beside the character is none of its bodies."""
    xml, ball = tiny.write_character(tmp_path), '<body name="puck" pos="1 0 0"><freejoint/>'
    table = '<body name="table" pos="3 0 0"><geom size="1" mass="90"/></body>'
    text = xml.read_text().replace(
        "</worldbody>", f'{ball}<geom size=".1" mass="5"/></body>{table}</worldbody>'
    )
    xml.write_text(text)
    loaded = character_lib.load(str(xml))
    assert loaded.body_names == who.body_names
    assert loaded.mass == who.mass and loaded.model.nu == who.model.nu
    assert pose.own_bodies(loaded.model) == 4 and loaded.model.nbody == 7
    assert loaded.layout.own == who.layout


def _hanging(spec: mujoco.MjSpec) -> None:
    body = spec.body("torso").add_body(name="thing")
    body.add_joint(name="thing", type=SLIDE)
    body.add_geom(size=[0.1, 0.0, 0.0])


def _loose(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name="thing")
    body.add_joint(name="thing", type=FREE)
    body.add_geom(size=[0.1, 0.0, 0.0])


def _fixed(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_body(name="thing").add_geom(size=[0.1, 0.0, 0.0])


@pytest.mark.parametrize(
    ("thing", "message"),
    [
        (Object("torso", _ball), "object 'torso': a body has that name, give another"),
        (Object("thing", _hanging), "object 'thing': give it slide joints, in a body of the world"),
        (Object("thing", _loose), "object 'thing': give it slide joints, in a body of the world"),
        (Object("thing", _fixed), "object 'thing': give it slide joints, in a body of the world"),
        (BLOCK, "object 'block' moves: give a reference that does not loop"),
    ],
)
def test_what_is_no_object(who: Character, thing: Object, message: str):
    loop = tiny.make_motion(who, tiny.walking(), True)
    with pytest.raises(UserError) as raised:
        objects.add(who, loop, [thing])
    assert str(raised.value) == message


def test_an_object_that_is_not_there(both: tuple[Character, Motion]):
    with pytest.raises(UserError) as raised:
        objects.place(both[0], "bell")
    assert str(raised.value) == "unknown object beside walker 'bell': choose one of block, ball"


def test_a_trainer_keeps_its_objects(tmp_path: Path):
    """Also with finer physics, and where it is evaluated."""
    made = trainer.make(tiny.train_config(tmp_path, horizon=2), things=[BALL])
    for one in (made, trainer.refined(made)):
        assert [thing.name for thing in one.character.objects] == ["ball"]
        assert "ball_z" in one.env.endings and one.motion.qpos.shape[1] == 16
    state, metrics = jit(made.update)(jit(made.init)(jax.random.key(0)))
    assert np.isfinite(float(metrics["reward"]))
    trace = jit(evaluate.make(made, EvaluateConfig(0.2, episodes=2)))(state, jax.random.key(1))
    assert trace.qpos.shape == (6, 2, 16)
    np.testing.assert_allclose(trace.qpos[..., 13:], 0.0, atol=1e-6)


def test_nothing_is_added_to_nothing(who: Character, walk: Motion):
    assert objects.add(who, walk, ()) == (who, walk)
    assert objects.scene(who, 30.0) is None
