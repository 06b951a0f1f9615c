# SPDX-License-Identifier: Apache-2.0
"""What every physics backend promises, checked against plain C `mj_step` loops."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from physics_cases import (
    ROWS,
    SUBSTEPS,
    VARIANT,
    Case,
    bits,
    c_loop,
    flat,
    inputs,
    shared_case,
    toy,
)

from jaxskills import physics
from jaxskills.compilation import jit
from jaxskills.errors import UserError

pytestmark = pytest.mark.timeout(300)

# Largest difference to C after 12 control steps with contacts, in m, rad, m/s or rad/s. The cpu
# backend is C: equal bits. The others compute in float32 and with solvers of their own.
AGREEMENT = {"cpu": 0.0, "callback": 0.0, "mjx": 2e-3, "warp": 5e-3}
# Largest difference between batch sizes: XLA may order sums differently.
SHAPES = {"cpu": 0.0, "callback": 0.0, "mjx": 1e-4, "warp": 1e-4}


def needs_warp(name: str) -> str:
    """Skips the warp cases where it is not installed."""
    if name == "warp" and importlib.util.find_spec("warp") is None:
        pytest.skip("warp-lang is not installed")
    return name


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
    one = jit(case.engine.step)
    for i in range(2):
        row = jax.tree.map(lambda x, i=i: x[i], state)
        alone = one(case.loaded, VARIANT[i], row, ctrl[0, i])
        assert np.abs(flat(alone) - together[i]).max() <= SHAPES[case.name]
    fold = lambda x: jnp.asarray(x).reshape(2, 3, *x.shape[1:])  # noqa: E731
    nested = jit(jax.vmap(jax.vmap(case.engine.step, (None, 0, 0, 0)), (None, 0, 0, 0)))
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

    @jit
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


def test_bad_arguments_are_refused():
    with pytest.raises(UserError, match="'gpu': choose one of cpu, mjx, warp"):
        physics.make("gpu", 4, num_envs=1)
    with pytest.raises(UserError, match="substeps is 0"):
        physics.make("cpu", 0, num_envs=1)
    assert physics.default_backend() in physics.BACKENDS
