# SPDX-License-Identifier: Apache-2.0
"""Boxes on the floor are ground: tables by hand, MuJoCo's distances, starts and falls on them."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character, ground, kinematics, terrain
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, core, obstacles, variants
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import TaskSpec, placed
from jaxskills.kinematics import Bodies

INF = float("inf")


def _at(*places: tuple[float, float, float]) -> Bodies:
    count = len(places)
    rot, zero = jnp.tile(jnp.eye(3), (count, 1, 1)), jnp.zeros((count, 3))
    return Bodies(jnp.array(places), rot, zero, zero, jnp.zeros(3), jnp.zeros(3))


def _balls(count: int, radius: float, yaw: float = 0.0) -> terrain.Boxes:
    """Returns a box of 1 m by 0.5 m around (1, 0), 0.4 m high, and balls at the bodies' origins."""
    return terrain.Boxes(
        jnp.array([[1.0, 0.0]]),
        jnp.array([[np.cos(yaw), np.sin(yaw)]]),
        jnp.array([[0.5, 0.25]]),
        jnp.array([0.4]),
        jnp.zeros((count, 3)),
        jnp.full(count, radius),
        body=tuple(range(count)),
    )


@pytest.mark.parametrize(
    ("place", "touching", "inside"),
    [
        ((1.0, 0.0, 1.0), 0.5, 0.5),  # over it
        ((1.4, -0.2, 0.5), 0.0, 0.0),  # lies on it
        ((2.0, 0.0, 1.0), INF, INF),  # somewhere else
        ((1.55, 0.0, 0.6), 0.2 - 0.0075**0.5, 0.2 - 0.0075**0.5),  # over its edge
        ((1.55, 0.0, 0.3), INF, INF),  # leans against its side
        ((1.0, 0.0, 0.35), -0.15, -0.15),  # sinks in from above
        ((1.48, 0.0, 0.2), INF, -0.3),  # from the side
    ],
)
def test_a_ball_over_a_box(place, touching: float, inside: float):
    found = [terrain.heights(_balls(1, 0.1), _at(place), x)[0] for x in (False, True)]
    np.testing.assert_allclose(found, (touching, inside), atol=1e-6)


def test_the_highest_box_counts_and_boxes_may_be_turned():
    turned = _balls(2, 0.0, np.pi / 2)
    found = terrain.heights(turned, _at((1.2, 0.4, 1.0), (1.4, 0.2, 1.0)))
    np.testing.assert_allclose(found, (0.6, INF), atol=1e-6)
    two = jax.tree.map(lambda x: jnp.concatenate((x, x)), dataclasses.replace(turned, body=()))
    higher = dataclasses.replace(
        turned, middle=two.middle, along=two.along, half=two.half, top=jnp.array([0.4, 0.9])
    )
    np.testing.assert_allclose(terrain.heights(higher, _at(*[(1.0, 0.0, 1.0)] * 2)), 0.1, atol=1e-6)


SHAPES = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <geom name="low" type="box" pos="0 0 0.1" size="2 2 0.2"/>
    <geom name="table" type="box" pos="0 0 3" size="2 2 0.2"/>
    <geom name="air" type="box" pos="0 0 0.1" size="2 2 0.4" contype="0" conaffinity="0"/>
    <body><freejoint/><geom SHAPE/></body>
  </worldbody>
  <asset><mesh name="brick" vertex="-.1 -.1 -.1 .1 -.1 -.1 -.1 .1 -.1 .1 .1 -.1 -.1 -.1 .1 .1 -.1 .1
    -.1 .1 .1 .1 .1 .1"/></asset>
</mujoco>
"""


@pytest.mark.parametrize(
    "shape",
    [
        'type="sphere" size="0.1" pos="0.05 0 0"',
        'type="capsule" size="0.05 0.2" euler="20 30 0"',
        'type="box" size="0.1 0.05 0.02" pos="0 0.1 0" euler="0 0 40"',
        'type="mesh" mesh="brick"',
    ],
)
def test_distances_are_those_of_the_c_engine(shape: str):
    model = mujoco.MjModel.from_xml_string(SHAPES.replace("SHAPE", shape))
    shapes, tree = ground.shapes(model), kinematics.tree(model)
    assert shapes.boxes is not None and shapes.boxes.top.tolist() == pytest.approx([0.3])
    data, random = mujoco.MjData(model), np.random.default_rng(0)
    clearance = jax.jit(
        lambda q: ground.clearance(
            shapes,
            kinematics.kinematics(tree, kinematics.body_params(model), q, jnp.zeros(model.nv)),
        )
    )
    for _ in range(20):
        data.qpos[:3] = random.uniform((-1.0, -1.0, 0.6), (1.0, 1.0, 1.5))
        data.qpos[3:] = random.normal(size=4)
        data.qpos[3:] /= np.linalg.norm(data.qpos[3:])
        mujoco.mj_kinematics(model, data)
        low = model.geom("low").id
        expected = mujoco.mj_geomDistance(model, data, low, model.body_geomadr[1], 9.0, None)
        np.testing.assert_allclose(clearance(jnp.asarray(data.qpos)), expected, atol=2e-5)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="module")
def who(plain: Character) -> Character:
    """A walker behind whom a box of 0.3 m stands, from x = -1.5 to -0.5."""
    return placed(TaskSpec(scenery=(obstacles.box((-1.0, 0.0), (1.0, 1.0), 0.3),)), plain)


@pytest.fixture(scope="module")
def env(who: Character) -> core.Environment:
    """Nothing ever moves in it."""
    stand = tiny.make_motion(who, tiny.standing(), False)
    rows = variants.one(who, stand, None)
    made = core.make(
        who, rows, tiny.stopped(), bounds.make(who, bounds.BoundsConfig()), EnvConfig(stop="fall")
    )
    return made._replace(place=jit(made.place), step=jit(made.step))


def test_without_boxes_nothing_is_computed_for_them(plain: Character, who: Character):
    without, among = ground.shapes(plain.model), ground.shapes(who.model)
    assert without.boxes is None and among.boxes is not None
    bodies = _at((0.0, 0.0, 0.5), (0.0, 0.1, 0.7), (0.1, 0.2, 0.33), (0.0, -0.1, 0.51))
    programs = {
        str(jax.make_jaxpr(lambda b, x=inside: ground.clearance(without, b, x))(bodies))
        for inside in (False, True)
    }
    bare = dataclasses.replace(among, boxes=None)
    assert programs == {str(jax.make_jaxpr(lambda b: ground.clearance(bare, b))(bodies))}
    # Nor does a box elsewhere change a bit.
    here, there = (jax.jit(ground.clearance)(shapes, bodies) for shapes in (without, among))
    assert here.tolist() == there.tolist()


@pytest.mark.parametrize(
    ("x", "z", "lifted"),
    [
        (0.0, 0.5, 0.001),  # on the floor
        (-1.0, 0.5, 0.301),  # the same pose where the box is: on it
        (-1.0, 0.7, 0.101),  # deep in it
        (-1.0, 0.9, 0.0),  # over it
        (-0.56, 0.6, 0.201),  # its heels are over the box
    ],
)
def test_starts_are_lifted_onto_the_ground(
    env: core.Environment, x: float, z: float, lifted: float
):
    qpos = jnp.asarray(tiny.standing()[0], jnp.float32).at[0].set(x).at[2].set(z)
    state = env.place(jnp.float32(0.0), qpos, jnp.zeros(11))
    assert float(state.sim.qpos[2]) == pytest.approx(z + lifted, abs=1e-5)


@pytest.mark.parametrize(
    ("x", "z", "fallen"),
    [
        (0.0, 0.05, True),  # sits on the floor
        (0.0, 0.349, False),  # as high beside the box
        (-1.0, 0.349, True),  # sits on the box
        (-1.0, 0.799, False),  # stands on it
    ],
)
def test_sitting_on_a_box_is_a_fall(env: core.Environment, x: float, z: float, fallen: bool):
    """The pelvis' underside is 5 cm below its origin; legs spread, so that it may come down."""
    qpos = jnp.asarray(tiny.standing()[0], jnp.float32).at[0].set(x).at[2].set(z)
    qpos = qpos.at[tiny.LEFT_HIP].set(1.5).at[tiny.RIGHT_HIP].set(-1.5) if z < 0.7 else qpos
    state = env.place(jnp.float32(0.0), qpos, jnp.zeros(11))
    state = dataclasses.replace(state, sim=dataclasses.replace(state.sim, qpos=qpos))
    assert bool(env.step(state, jnp.zeros(5))[1].report.fallen) == fallen


def test_a_ball_comes_to_rest_on_a_box(tmp_path):
    path = tmp_path / "ball.xml"
    path.write_text("""
      <mujoco><worldbody>
        <geom name="floor" type="plane" size="0 0 1"/>
        <body name="ball" pos="0 0 1.2"><freejoint name="root"/><geom size="0.1" mass="2"/></body>
      </worldbody></mujoco>""")
    ball = character.load(str(path))
    for top in (0.0, 0.05, 0.7):
        box = obstacles.box((0.0, 0.0), (1.0, 1.0), top)
        model = placed(TaskSpec(scenery=(box,)), ball).model
        data = mujoco.MjData(model)
        for _ in range(240):
            mujoco.mj_step(model, data)
        assert data.qpos[2] == pytest.approx(top + 0.1, abs=0.003)
        assert np.abs(data.qvel).max() < 0.05
