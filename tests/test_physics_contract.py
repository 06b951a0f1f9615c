# SPDX-License-Identifier: Apache-2.0
"""What every physics backend promises, checked against plain C `mj_step` loops."""

import dataclasses
import functools
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxskills import character, physics
from jaxskills.errors import UserError
from jaxskills.physics import cpu, ffi

physics.configure_cpu()

pytestmark = pytest.mark.timeout(300)

SUBSTEPS = 4
ROWS = 6
VARIANT = jnp.array([0, 1, 2, 0, 1, 2], jnp.int32)

# Largest difference to C after 12 control steps with contacts, in m, rad, m/s or rad/s. The cpu
# backend is C: equal bits. The others compute in float32 and with solvers of their own.
AGREEMENT = {"cpu": 0.0, "callback": 0.0, "mjx": 2e-3, "warp": 5e-3}
# Largest difference between batch sizes: XLA may order sums differently.
SHAPES = {"cpu": 0.0, "callback": 0.0, "mjx": 1e-4, "warp": 1e-4}

TOY = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 {gravity}" iterations="8">
    <flag autoreset="{autoreset}"/>
  </option>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" contype="0" conaffinity="0"/>
    <body name="trunk" pos="0 0 0.3">
      <freejoint/>
      <geom name="ball" type="sphere" size="0.1" mass="{mass}" contype="0" conaffinity="0"/>
      <body name="arm" pos="0.1 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.2 0 0" mass="0.5" contype="0"
          conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <contact><pair geom1="floor" geom2="ball" condim="3"/></contact>
  <actuator>
    <position joint="elbow" kp="5" kv="0.2"/>
    <motor joint="elbow" gear="1"/>
  </actuator>
</mujoco>
"""


def toy(mass: float = 2.0, gravity: float = -9.81, autoreset: str = "disable") -> mujoco.MjModel:
    """A ball with an arm above a floor: 8 coordinates, 7 velocities, 2 controls."""
    text = TOY.format(mass=mass, gravity=gravity, autoreset=autoreset)
    return mujoco.MjModel.from_xml_string(text)


@dataclasses.dataclass
class Case:
    """A backend with three variants loaded, and its step compiled once for `ROWS` rows."""

    name: str
    engine: physics.Physics
    models: list[mujoco.MjModel]
    loaded: Any
    init: Any
    step: Any

    def start(self, qpos: np.ndarray, qvel: np.ndarray, variant=VARIANT) -> physics.SimState:
        """Returns the state of `ROWS` environments."""
        return self.init(self.loaded, variant, jnp.asarray(qpos), jnp.asarray(qvel))


def make_case(name: str, models: list[mujoco.MjModel]) -> Case:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(cpu.CALLBACK_VARIABLE, "1" if name == "callback" else "0")
        backend = "cpu" if name == "callback" else name
        engine = physics.make(backend, SUBSTEPS, num_envs=ROWS)
    return Case(
        name=name,
        engine=engine,
        models=models,
        loaded=engine.load(models),
        init=jax.jit(jax.vmap(engine.init, (None, 0, 0, 0))),
        step=jax.jit(jax.vmap(engine.step, (None, 0, 0, 0))),
    )


def needs_warp(name: str) -> str:
    """Skips the warp cases where it is not installed."""
    if name == "warp" and importlib.util.find_spec("warp") is None:
        pytest.skip("warp-lang is not installed")
    return name


@functools.cache
def shared_case(name: str) -> Case:
    """The backend with models that differ in mass and in gravity, compiled once for all tests."""
    return make_case(name, [toy(), toy(mass=3.0), toy(gravity=-1.6)])


SLOW_WARP = pytest.param("warp", marks=[pytest.mark.slow, pytest.mark.timeout(1200)])  # kernels
SLOW_MJX = pytest.param("mjx", marks=pytest.mark.slow)  # each new shape compiles for 15 s


@pytest.fixture(params=["cpu", "callback", "mjx", SLOW_WARP])
def case(request: pytest.FixtureRequest) -> Case:
    """One backend after the other."""
    return shared_case(needs_warp(request.param))


@pytest.fixture(params=["cpu", "callback", SLOW_MJX, SLOW_WARP])
def reshaped_case(request: pytest.FixtureRequest) -> Case:
    """The same, for tests that compile the step in other shapes."""
    return shared_case(needs_warp(request.param))


def inputs(rows: int = ROWS, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """float32 qpos [rows, 8], qvel [rows, 7], ctrl [12, rows, 2]: it falls, bounces and swings."""
    random = np.random.default_rng(seed)
    qpos = np.tile(toy().qpos0, (rows, 1))
    qpos[:, 2] = random.uniform(0.11, 0.2, rows)
    qpos[:, 7] = random.uniform(-1, 1, rows)
    qvel = random.normal(size=(rows, 7)) * 0.5
    ctrl = random.normal(size=(12, rows, 2))
    return tuple(np.asarray(x, np.float32) for x in (qpos, qvel, ctrl))  # type: ignore


def c_loop(model: mujoco.MjModel, qpos, qvel, ctrls, substeps: int = SUBSTEPS) -> np.ndarray:
    """Returns (qpos, qvel) after plain `mj_step`, carried as float32 between control steps."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    for ctrl in ctrls:
        data.ctrl[:] = ctrl
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        for field in (data.qpos, data.qvel, data.qacc_warmstart):
            field[:] = field.astype(np.float32)
    return np.concatenate([data.qpos, data.qvel])


def flat(state: physics.SimState) -> np.ndarray:
    """Returns [rows, nq + nv]."""
    return np.concatenate([np.asarray(state.qpos), np.asarray(state.qvel)], axis=-1)


def bits(state: physics.SimState) -> bytes:
    """Returns the whole state as bytes."""
    return b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state))


def test_agrees_with_a_c_loop(case: Case):
    qpos, qvel, ctrl = inputs()
    state = case.start(qpos, qvel)
    for control in ctrl:
        state = case.step(case.loaded, VARIANT, state, control)
    expected = np.stack(
        [c_loop(case.models[v], qpos[i], qvel[i], ctrl[:, i]) for i, v in enumerate(VARIANT)]
    )
    assert not state.diverged.any()
    assert np.abs(expected[:, 9]).max() > 0.01, "the ball must have moved sideways"
    assert np.abs(flat(state) - expected).max() <= AGREEMENT[case.name]


def test_touches_the_floor(case: Case):
    """Without this, agreement would say nothing about contacts."""
    qpos, qvel, ctrl = inputs()
    qvel[:, 2] = -1.0
    state = case.start(qpos, qvel)
    for control in ctrl[:8]:
        state = case.step(case.loaded, VARIANT, state, control)
    assert (np.asarray(state.qpos)[:, 2] > 0.08).all()


def test_is_pure(case: Case):
    qpos, qvel, ctrl = inputs()
    state = case.start(qpos, qvel)
    once = case.step(case.loaded, VARIANT, state, ctrl[0])
    other = case.start(qpos + 0.01, -qvel)
    case.step(case.loaded, VARIANT[::-1], other, ctrl[1])
    again = case.step(case.loaded, VARIANT, state, ctrl[0])
    assert bits(once) == bits(again)


def test_the_warm_start_is_part_of_the_state(case: Case):
    """A step after a step equals the same step from a copy of the state: nothing else is kept."""
    qpos, qvel, ctrl = inputs()
    first = case.step(case.loaded, VARIANT, case.start(qpos, qvel), ctrl[0])
    copied = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), first)
    second = case.step(case.loaded, VARIANT, first, ctrl[1])
    case.step(case.loaded, VARIANT, second, ctrl[2])
    assert bits(second) == bits(case.step(case.loaded, VARIANT, copied, ctrl[1]))


def test_vmapped_equals_looped_and_nested(reshaped_case: Case):
    case = reshaped_case
    qpos, qvel, ctrl = inputs()
    state = case.start(qpos, qvel)
    together = flat(case.step(case.loaded, VARIANT, state, ctrl[0]))
    one = jax.jit(case.engine.step)
    for i in range(2):
        row = jax.tree.map(lambda x, i=i: x[i], state)
        alone = one(case.loaded, VARIANT[i], row, ctrl[0, i])
        assert np.abs(flat(alone) - together[i]).max() <= SHAPES[case.name]
    fold = lambda x: jnp.asarray(x).reshape(2, 3, *x.shape[1:])  # noqa: E731
    nested = jax.jit(jax.vmap(jax.vmap(case.engine.step, (None, 0, 0, 0)), (None, 0, 0, 0)))
    folded = nested(case.loaded, fold(VARIANT), jax.tree.map(fold, state), fold(ctrl[0]))
    assert folded.diverged.shape == (2, 3)
    assert np.abs(flat(folded).reshape(ROWS, -1) - together).max() <= SHAPES[case.name]


def test_a_variant_changes_its_own_rows_only(case: Case):
    qpos, qvel, ctrl = inputs()
    plain = jnp.zeros(ROWS, jnp.int32)
    same = case.step(case.loaded, plain, case.start(qpos, qvel, plain), ctrl[0])
    mixed = case.step(case.loaded, VARIANT, case.start(qpos, qvel), ctrl[0])
    changed = np.abs(flat(same) - flat(mixed)).max(axis=1)
    assert (changed[np.asarray(VARIANT) == 0] == 0).all()
    assert (changed[np.asarray(VARIANT) != 0] > 1e-4).all()


def test_free_fall(case: Case):
    qpos, qvel, _ = inputs()
    qpos[:], qvel[:] = toy().qpos0, 0.0
    qpos[:, 2] = 50.0
    state, steps = case.start(qpos, qvel), 25
    for _ in range(steps):
        state = case.step(case.loaded, VARIANT, state, jnp.zeros((ROWS, 2)))
    gravity = np.array([9.81, 9.81, 1.6])[np.asarray(VARIANT)]
    h, n = 0.005, steps * SUBSTEPS
    fallen = 50.0 - np.asarray(state.qpos)[:, 2]
    np.testing.assert_allclose(fallen, gravity * h * h * n * (n + 1) / 2, rtol=2e-4)
    np.testing.assert_allclose(fallen, gravity * (n * h) ** 2 / 2, rtol=1.2 / n)


@pytest.mark.parametrize("where", ["qpos", "qvel", "ctrl", "huge"])
def test_unsound_input_is_reported_and_contained(case: Case, where: str):
    qpos, qvel, ctrl = inputs()
    control = ctrl[0].copy()
    clean = case.step(case.loaded, VARIANT, case.start(qpos, qvel), control)
    {"qpos": qpos, "qvel": qvel, "ctrl": control, "huge": qpos}[where][2, 0] = (
        1e30 if where == "huge" else np.nan
    )
    state = case.step(case.loaded, VARIANT, case.start(qpos, qvel), control)
    assert state.diverged.tolist() == [False, False, True, False, False, False]
    assert np.isfinite(flat(state)).all()
    others = np.array([0, 1, 3, 4, 5])
    assert (flat(state)[others] == flat(clean)[others]).all()


def test_a_blow_up_is_reported_and_stays_until_init(case: Case):
    """A torque far beyond reason: C would reset the row in silence, or carry on with nonsense."""
    qpos, qvel, ctrl = inputs()
    control = ctrl[0].copy()
    control[4, 1] = 9e9
    before = case.start(qpos, qvel)
    state = case.step(case.loaded, VARIANT, before, control)
    assert state.diverged.tolist() == [False, False, False, False, True, False]
    assert (flat(state)[4] == flat(before)[4]).all(), "the last sound state"
    after = case.step(case.loaded, VARIANT, state, ctrl[1])
    assert after.diverged.tolist() == state.diverged.tolist()
    assert (flat(after)[4] == flat(before)[4]).all()
    assert not case.start(qpos, qvel).diverged.any()


def test_scan_equals_single_steps(reshaped_case: Case):
    case = reshaped_case
    qpos, qvel, ctrl = inputs()
    state = case.start(qpos, qvel)

    @jax.jit
    def scan(loaded, state, ctrl):
        step = jax.vmap(case.engine.step, (None, 0, 0, 0))
        return jax.lax.scan(lambda s, u: (step(loaded, VARIANT, s, u), None), state, ctrl)[0]

    scanned = scan(case.loaded, state, ctrl[:5])
    for control in ctrl[:5]:
        state = case.step(case.loaded, VARIANT, state, control)
    assert np.abs(flat(scanned) - flat(state)).max() <= 10 * SHAPES[case.name]


def test_loading_again_needs_no_new_program(case: Case):
    """Curricula load new variants all the time; a new compilation each time would be ruin."""
    qpos, qvel, ctrl = inputs()
    state = case.start(qpos, qvel)
    case.step(case.loaded, VARIANT, state, ctrl[0])
    programs = case.step._cache_size()
    loaded = case.engine.load([toy(), toy(mass=5.0), toy(gravity=-20.0)])
    other = case.step(loaded, VARIANT, state, ctrl[0])
    assert case.step._cache_size() == programs
    expected = c_loop(toy(mass=5.0), qpos[1], qvel[1], ctrl[:1, 1])
    assert np.abs(flat(other)[1] - expected).max() <= AGREEMENT[case.name]


def test_a_silent_reset_is_noticed():
    """Models with MuJoCo's auto-reset left on are caught as well."""
    case = make_case("cpu", [toy(autoreset="enable")])
    qpos, qvel, ctrl = inputs()
    variant = jnp.zeros(ROWS, jnp.int32)
    control = ctrl[0].copy()
    control[1, 1] = 9e9
    state = case.step(case.loaded, variant, case.start(qpos, qvel, variant), control)
    assert state.diverged.tolist() == [False, True, False, False, False, False]


def test_thread_count_does_not_change_bits():
    rows = 17
    qpos, qvel, ctrl = inputs(rows)
    variant = jnp.arange(rows, dtype=jnp.int32) % 2
    results = set()
    for threads in (1, 2, 5):
        engine = physics.make("cpu", SUBSTEPS, num_envs=rows, threads=threads)
        loaded = engine.load([toy(), toy(mass=3.0)])
        state = jax.vmap(engine.init, (None, 0, 0, 0))(loaded, variant, qpos, qvel)
        step = jax.jit(jax.vmap(engine.step, (None, 0, 0, 0)))
        for control in ctrl:
            state = step(loaded, variant, state, control)
        results.add(bits(state))
    assert len(results) == 1


def test_bad_models_are_refused():
    engine = physics.make("cpu", 1, num_envs=1)
    with pytest.raises(UserError, match="none"):
        engine.load([])
    single = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(UserError, match="differ in nq"):
        engine.load([toy(), single])
    muscle = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j'/><geom size='1'/></body></worldbody>"
        "<actuator><intvelocity joint='j' kp='1' actrange='-1 1'/></actuator></mujoco>"
    )
    with pytest.raises(UserError, match="na = 1"):
        engine.load([muscle])


def test_mjx_names_what_it_cannot_vary():
    engine = physics.make("mjx", 1, num_envs=1)
    masked = toy()
    masked.geom_contype[1] = 1
    with pytest.raises(UserError, match="geom_contype"):
        engine.load([toy(), masked])


def test_bad_arguments_are_refused():
    with pytest.raises(UserError, match="'gpu': choose one of cpu, mjx, warp"):
        physics.make("gpu", 4, num_envs=1)
    with pytest.raises(UserError, match="substeps is 0"):
        physics.make("cpu", 0, num_envs=1)
    assert physics.default_backend() in physics.BACKENDS


@pytest.mark.parametrize("name", ["cpu", "callback"])
def test_programming_errors_surface(name: str):
    """A variant that is not there, a model that is no longer in memory: an error, not garbage."""
    case = make_case(name, [toy()])
    qpos, qvel, ctrl = inputs()
    zero = jnp.zeros(ROWS, jnp.int32)
    state = case.start(qpos, qvel, zero)
    with pytest.raises(jax.errors.JaxRuntimeError, match="outside 0..0"):
        jax.block_until_ready(case.step(case.loaded, zero + 1, state, ctrl[0]))
    gone = case.loaded.replace(handle=np.int32(7))
    with pytest.raises(jax.errors.JaxRuntimeError, match="not in memory"):
        jax.block_until_ready(case.step(gone, zero, state, ctrl[0]))
    case.step(case.loaded, zero, state, ctrl[0])


def test_memory_is_bounded():
    case = make_case("cpu", [toy()])
    for i in range(cpu.KEPT + 3):
        case.engine.load([toy(mass=10.0 + i)])
    assert len(cpu._simulators) == cpu.KEPT
    assert case.engine.load([toy()]).handle == case.loaded.handle, "named by content"


def test_leaves_no_log_and_prints_nothing(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    case = make_case("cpu", [toy()])
    qpos, qvel, ctrl = inputs()
    zero = jnp.zeros(ROWS, jnp.int32)
    control = np.full_like(ctrl[0], 9e9)
    state = case.step(case.loaded, zero, case.start(qpos, qvel, zero), control)
    assert state.diverged.all()
    data = mujoco.MjData(toy())
    data.qpos[0] = np.nan
    mujoco.mj_step(toy(), data)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_an_older_interface_falls_back(monkeypatch):
    """Where XLA refuses the handler, the callback takes over and gives the same bits."""
    qpos, qvel, ctrl = inputs()
    zero = jnp.zeros(ROWS, jnp.int32)
    results = []
    for refused in (False, True):
        if refused:
            monkeypatch.setattr(ffi, "register", lambda name, kernel: False)
        case = make_case("cpu", [toy()])
        program = case.step.lower(case.loaded, zero, case.start(qpos, qvel, zero), ctrl[0])
        assert (cpu.TARGET in program.as_text()) != refused
        state = case.step(case.loaded, zero, case.start(qpos, qvel, zero), ctrl[0])
        results.append(bits(state))
    assert results[0] == results[1]


def test_the_shipped_humanoid_equals_c():
    model = character.load("humanoid34").model
    case = make_case("cpu", [model])
    random = np.random.default_rng(1)
    qpos = np.tile(model.qpos0, (ROWS, 1))
    for row in qpos:
        mujoco.mj_integratePos(model, row, random.normal(size=model.nv) * 0.1, 1.0)
    qpos = qpos.astype(np.float32)
    qvel = np.zeros((ROWS, model.nv), np.float32)
    ctrl = (random.normal(size=(20, ROWS, model.nu)) * 0.2).astype(np.float32)
    zero = jnp.zeros(ROWS, jnp.int32)
    state = case.start(qpos, qvel, zero)
    for control in ctrl:
        state = case.step(case.loaded, zero, state, control)
    expected = [c_loop(model, qpos[i], qvel[i], ctrl[:, i]) for i in range(ROWS)]
    assert not state.diverged.any()
    assert (flat(state) == np.stack(expected).astype(np.float32)).all()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_shipped_humanoid_in_mjx_follows_c():
    model = character.load("humanoid34").model
    case = make_case("mjx", [model])
    qpos = np.tile(model.qpos0, (ROWS, 1)).astype(np.float32)
    qpos[:, 2] += np.linspace(0.0, 0.05, ROWS)
    qvel = np.zeros((ROWS, model.nv), np.float32)
    zero = jnp.zeros(ROWS, jnp.int32)
    ctrl = np.zeros((5, ROWS, model.nu), np.float32)
    state = case.start(qpos, qvel, zero)
    for control in ctrl:
        state = case.step(case.loaded, zero, state, control)
    expected = [c_loop(model, qpos[i], qvel[i], ctrl[:, i]) for i in range(ROWS)]
    assert np.abs(flat(state) - np.stack(expected)).max() < 0.02


def run_alone(script: str, tmp_path: Path, **variables: str) -> str:
    """Runs Python code in a fresh process, two minutes at most; returns what it printed."""
    source = str(Path(physics.__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": f"{source}:{Path(__file__).parent}", **variables}
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


CACHED = """
import jax
jax.config.update("jax_compilation_cache_dir", "cache")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
import test_physics_contract as t
case = t.make_case("cpu", [t.toy(), t.toy(mass=3.0), t.toy(gravity=-1.6)])
qpos, qvel, ctrl = t.inputs()
state = case.start(qpos, qvel)
state = case.step(case.loaded, t.VARIANT, state, ctrl[0])
print(t.bits(state).hex())
"""


def test_a_second_process_finds_the_program_in_the_cache(tmp_path):
    first = run_alone(CACHED, tmp_path)
    programs = {path.name for path in (tmp_path / "cache").iterdir() if "jit_step" in path.name}
    assert programs
    # Another model comes first this time: the handle must not depend on the order of loading.
    second = run_alone(CACHED.replace("case =", "t.make_case('cpu', [t.toy(9.0)])\ncase ="), tmp_path)
    after = {path.name for path in (tmp_path / "cache").iterdir() if "jit_step" in path.name}
    assert {name for name in after if name.endswith("-cache")} == {
        name for name in programs if name.endswith("-cache")
    }
    assert first == second


CROWD = """
from jaxskills import physics
import jax
import jax.numpy as jnp
import test_physics_contract as t
qpos, qvel, ctrl = t.inputs(64)
engine = physics.make("mjx", 2, num_envs=64)
loaded = engine.load([t.toy()])
zero = jnp.zeros(64, jnp.int32)
state = jax.vmap(engine.init, (None, 0, 0, 0))(loaded, zero, qpos, qvel)
step = jax.jit(jax.vmap(engine.step, (None, 0, 0, 0)))
for _ in range(30):
    state = step(loaded, zero, state, ctrl[0])
print(int(state.diverged.sum()))
"""


def test_mjx_with_many_environments_on_two_cores_ends(tmp_path):
    """XLA's thread pool of two threads would wait for itself for ever."""
    assert run_alone(CROWD, tmp_path, NPROC="2").strip() == "0"


def test_mjx_refuses_a_pool_that_is_too_small(tmp_path):
    script = "import jax; jax.devices()\n" + CROWD.replace("physics.make", "make").replace(
        "engine = make",
        "import pytest\nfrom jaxskills.errors import UserError\n"
        "with pytest.raises(UserError, match='NPROC'): physics.make('mjx', 2, num_envs=64)\n"
        "raise SystemExit\nengine = make",
    )
    run_alone(script, tmp_path, NPROC="2")
