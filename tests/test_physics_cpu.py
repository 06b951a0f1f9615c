# SPDX-License-Identifier: Apache-2.0
"""The cpu backend's own promises: threads, memory, errors, logs, caching, and what it refuses."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_cases import (
    PLAIN,
    ROWS,
    SUBSTEPS,
    bits,
    c_loop,
    flat,
    inputs,
    make_case,
    run_alone,
    toy,
)

from jaxskills import character, physics
from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.physics import cpu, ffi


def test_a_silent_reset_is_noticed():
    """Models with MuJoCo's auto-reset left on are caught as well."""
    case = make_case("cpu", [toy(autoreset="enable")])
    qpos, qvel, ctrl = inputs()
    control = ctrl[0].copy()
    control[1, 1] = 9e9
    state = case.step(case.loaded, PLAIN, case.start(qpos, qvel, PLAIN), control)
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
        step = jit(jax.vmap(engine.step, (None, 0, 0, 0)))
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


@pytest.mark.parametrize("name", ["cpu", "callback"])
def test_programming_errors_surface(name: str):
    """A variant that is not there, a model that is no longer in memory: an error, not garbage."""
    case = make_case(name, [toy()])
    qpos, qvel, ctrl = inputs()
    state = case.start(qpos, qvel, PLAIN)
    with pytest.raises(jax.errors.JaxRuntimeError, match="outside 0..0"):
        jax.block_until_ready(case.step(case.loaded, PLAIN + 1, state, ctrl[0]))
    gone = case.loaded.replace(handle=np.int32(7))
    with pytest.raises(jax.errors.JaxRuntimeError, match="not in memory"):
        jax.block_until_ready(case.step(gone, PLAIN, state, ctrl[0]))
    case.step(case.loaded, PLAIN, state, ctrl[0])


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
    control = np.full_like(ctrl[0], 9e9)
    state = case.step(case.loaded, PLAIN, case.start(qpos, qvel, PLAIN), control)
    assert state.diverged.all()
    data = mujoco.MjData(toy())
    data.qpos[0] = np.nan
    mujoco.mj_step(toy(), data)
    assert list(tmp_path.iterdir()) == []
    assert capfd.readouterr() == ("", "")


def test_an_older_interface_falls_back(monkeypatch):
    """Where XLA refuses the handler, the callback takes over and gives the same bits."""
    qpos, qvel, ctrl = inputs()
    results = []
    for refused in (False, True):
        if refused:
            monkeypatch.setattr(ffi, "register", lambda name, kernel: False)
        case = make_case("cpu", [toy()])
        program = case.step.lower(case.loaded, PLAIN, case.start(qpos, qvel, PLAIN), ctrl[0])
        assert (cpu.TARGET in program.as_text()) != refused
        state = case.step(case.loaded, PLAIN, case.start(qpos, qvel, PLAIN), ctrl[0])
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
    state = case.start(qpos, qvel, PLAIN)
    for control in ctrl:
        state = case.step(case.loaded, PLAIN, state, control)
    expected = [c_loop(model, qpos[i], qvel[i], ctrl[:, i]) for i in range(ROWS)]
    assert not state.diverged.any()
    assert (flat(state) == np.stack(expected).astype(np.float32)).all()


CACHED = """
import jax
import physics_cases as cases
jax.config.update("jax_compilation_cache_dir", "cache")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
OTHER = None
case = cases.shared_case("cpu")
qpos, qvel, ctrl = cases.inputs()
state = case.step(case.loaded, cases.VARIANT, case.start(qpos, qvel), ctrl[0])
print(cases.bits(state).hex())
"""


def test_a_second_process_finds_the_program_in_the_cache(tmp_path):
    def programs() -> set[str]:
        return {path.name for path in (tmp_path / "cache").glob("jit_step*-cache")}

    first = run_alone(CACHED, tmp_path)
    stored = programs()
    assert stored
    # Another model comes first this time: the handle must not depend on the order of loading.
    other = CACHED.replace("OTHER = None", "cases.make_case('cpu', [cases.toy(9.0)])")
    assert run_alone(other, tmp_path) == first
    assert programs() == stored
