# SPDX-License-Identifier: Apache-2.0
"""MJX's own promises: what it refuses, that it ends on few cores, and a whole humanoid."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from mujoco.mjx._src import collision_driver
from physics_cases import PLAIN, ROWS, c_loop, flat, make_case, run_alone, toy

from jaxskills import character, clip, physics, pose, retarget
from jaxskills.env import obstacles, task
from jaxskills.env.holds import Grip
from jaxskills.env.task import TaskSpec
from jaxskills.errors import UserError
from jaxskills.physics import box_floor, explicit

pytestmark = pytest.mark.timeout(300)


def test_mjx_names_what_it_cannot_vary():
    engine = physics.make("mjx", 1, num_envs=1)
    masked = toy()
    masked.geom_contype[1] = 1
    with pytest.raises(UserError, match="geom_contype"):
        engine.load([toy(), masked])


def test_sizes_of_geoms_may_differ():
    engine = physics.make("mjx", 1, num_envs=1)
    larger = toy()
    larger.geom_size[1] = 0.2
    larger.geom_rbound[1] = 0.2
    loaded = engine.load([toy(), larger])
    assert [leaf.shape[0] for leaf in loaded.varied] == [2, 2]


BOX = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body pos="0 0 0.02"><freejoint/><geom name="foot" type="box" size="0.09 0.045 0.03"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("tilt", [0.0, 0.02, 0.2, 1.0])
def test_a_tilted_box_touches_the_floor_where_c_says(tilt: float):
    """Unaided, MJX keeps the corners within 1 mm of the lowest: one, as soon as a foot tilts."""
    model = mujoco.MjModel.from_xml_string(BOX)
    data = mujoco.MjData(model)
    mujoco.mju_axisAngle2Quat(data.qpos[3:], np.array([0.6, 0.8, 0.0]), tilt)
    mujoco.mj_forward(model, data)
    placed = mjx.put_model(model)
    there = mjx.kinematics(placed, mjx.make_data(placed).replace(qpos=jnp.asarray(data.qpos)))
    dist, pos, frame = box_floor.collide(placed, there, None, jnp.array([[0, 1]]))
    assert dist.shape == (4,) and pos.shape == (4, 3) and frame.shape == (4, 3, 3)
    below = np.asarray(dist) < 0
    order = np.argsort(data.contact.dist)
    found = np.argsort(np.asarray(dist)[below])
    np.testing.assert_allclose(dist[below][found], data.contact.dist[order], atol=1e-6)
    if tilt:  # else all corners are equally deep, and their order means nothing
        np.testing.assert_allclose(pos[below][found], data.contact.pos[order], atol=1e-6)
    np.testing.assert_allclose(frame[:, 0], np.tile([0, 0, 1], (4, 1)), atol=1e-6)


def test_the_box_function_is_put_back():
    before = dict(collision_driver._COLLISION_FUNC)
    with pytest.raises(ZeroDivisionError), box_floor.installed():
        assert collision_driver._COLLISION_FUNC != before
        raise ZeroDivisionError
    assert collision_driver._COLLISION_FUNC == before


def flail(model: mujoco.MjModel, lift: float, steps: int) -> np.ndarray:
    """Returns [8, nq + nv] of a humanoid under random set points, `lift` m above the floor."""
    random = np.random.default_rng(0)
    ends = []
    for _ in range(8):
        data = mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv) * 0.05, 1.0)
        data.qpos[2] += lift
        data.ctrl[:] = random.normal(size=model.nu) * 0.1
        mujoco.mj_step(model, data, steps)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    return np.stack(ends)


def test_discrete_without_limits_and_contacts_is_exact():
    """Both in C, in float64: the change of the model alone, whatever engine runs it."""
    model = character.load("humanoid34").model
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    for absent in (mujoco.mjtDisableBit.mjDSBL_LIMIT, mujoco.mjtDisableBit.mjDSBL_CONTACT):
        model.opt.disableflags |= int(absent)
    changed = explicit.from_discrete(model)
    assert changed.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    np.testing.assert_allclose(flail(changed, 1.0, 4), flail(model, 1.0, 4), atol=1e-10)


def test_discrete_on_the_floor_is_close():
    """A control step of 4; `implicitfast` with its folded damping is ten times further away."""
    model = character.load("humanoid34").model
    expected = flail(model, 0.0, 4)
    folded = character.compile(
        character.load("humanoid34"), model.opt.timestep, integrator="implicitfast"
    )
    error = np.abs(flail(explicit.from_discrete(model), 0.0, 4) - expected)[:, : model.nq].max(1)
    before = np.abs(flail(folded, 0.0, 4) - expected)[:, : model.nq].max(1)
    assert np.median(error) < 2e-3
    assert np.median(error) < 0.1 * np.median(before)


@pytest.fixture(scope="module")
def hanging() -> tuple[mujoco.MjModel, np.ndarray, np.ndarray]:
    """A humanoid with its hands on a bar, a block under it; its pose, and controls that keep it."""
    who = character.load("humanoid34")
    grip = Grip(("left_wrist", "right_wrist"), 0.0, 1.0)
    objects = (
        obstacles.bar((0.56, 0.0), 2.3, grip=grip),
        obstacles.box((0.75, 0.0), (0.5, 1.2), 0.3),
    )
    model = task.placed(TaskSpec(scenery=objects), who).model
    qpos = retarget.retarget(who, clip.load("swing"))[30]
    targets = pose.rotation_vectors(who.layout, jnp.asarray(qpos))[who.actuated]
    return model, qpos, np.concatenate((np.ones(6), np.asarray(targets)))


def test_what_hands_hold_is_close(hanging: tuple[mujoco.MjModel, np.ndarray, np.ndarray]):
    """The pull is that of the beginning of each step: half a second of hanging and swinging."""
    model, qpos, ctrl = hanging
    ends = []
    for one in (model, explicit.from_discrete(model)):
        data = mujoco.MjData(one)
        data.qpos[:], data.ctrl[:] = qpos, ctrl
        mujoco.mj_step(one, data, 60)
        ends.append(data.qpos.copy())
        assert np.abs(data.body("left_wrist").xpos[[0, 2]] - [0.56, 2.3]).max() < 0.05
    assert np.abs(ends[0] - qpos).max() > 0.02
    np.testing.assert_allclose(ends[1], ends[0], atol=5e-3)


def test_discrete_refuses_what_it_cannot_express():
    text = "<mujoco><worldbody><body><joint name='j' stiffness='1'/><geom size='1'/></body>"
    sprung = mujoco.MjModel.from_xml_string(text + "</worldbody></mujoco>")
    with pytest.raises(UserError, match="jnt_stiffness"):
        explicit.from_discrete(sprung)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_shipped_humanoid_in_mjx_follows_c():
    model = character.load("humanoid34").model
    case = make_case("mjx", [model])
    qpos = np.tile(model.qpos0, (ROWS, 1)).astype(np.float32)
    qpos[:, 2] += np.linspace(0.0, 0.05, ROWS)
    qvel = np.zeros((ROWS, model.nv), np.float32)
    ctrl = np.zeros((5, ROWS, model.nu), np.float32)
    state = case.start(qpos, qvel, PLAIN)
    for control in ctrl:
        state = case.step(case.loaded, PLAIN, state, control)
    expected = [c_loop(model, qpos[i], qvel[i], ctrl[:, i]) for i in range(ROWS)]
    error = np.abs(flat(state) - np.stack(expected))
    assert error[:, : model.nq].max() < 0.01


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_hands_hold_a_bar_in_mjx(hanging: tuple[mujoco.MjModel, np.ndarray, np.ndarray]):
    model, one, target = hanging
    case = make_case("mjx", [model])
    qpos = np.tile(one, (ROWS, 1)).astype(np.float32)
    qvel = np.zeros((ROWS, model.nv), np.float32)
    ctrl = np.tile(target, (3, ROWS, 1)).astype(np.float32)
    state = case.start(qpos, qvel, PLAIN)
    for control in ctrl:
        state = case.step(case.loaded, PLAIN, state, control)
    expected = np.stack([c_loop(model, qpos[i], qvel[i], ctrl[:, i]) for i in range(ROWS)])
    assert np.abs(flat(state) - expected)[:, : model.nq].max() < 0.01


CROWD = """
import jax
import numpy as np
import physics_cases as cases
from jaxskills import physics
from jaxskills.compilation import jit
qpos, qvel, ctrl = cases.inputs(64)
engine = physics.make("mjx", 2, num_envs=64)
loaded = engine.load([cases.toy()])
variant = np.zeros(64, np.int32)
state = jax.vmap(engine.init, (None, 0, 0, 0))(loaded, variant, qpos, qvel)
step = jit(jax.vmap(engine.step, (None, 0, 0, 0)))
for _ in range(30):
    state = step(loaded, variant, state, ctrl[0])
print(int(state.diverged.sum()))
"""


def test_mjx_with_many_environments_on_two_cores_ends(tmp_path):
    """XLA's thread pool of two threads would wait for itself for ever."""
    assert run_alone(CROWD, tmp_path, NPROC="2").strip() == "0"


LATE = """
import jax
import pytest
from jaxskills import physics
from jaxskills.errors import UserError
jax.devices()
with pytest.raises(UserError, match="NPROC=8"):
    physics.make("mjx", 2, num_envs=64)
"""


def test_mjx_refuses_a_pool_that_is_too_small(tmp_path):
    """The pool cannot grow once jax runs: an error is better than a program that hangs."""
    run_alone(LATE, tmp_path, NPROC="2")
