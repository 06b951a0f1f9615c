# SPDX-License-Identifier: Apache-2.0
"""Servos: what they ask the engine for, and that limited torque is worth the same at any rate."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import character, pose
from jaxskills import physics as physics_lib
from jaxskills.character import Character
from jaxskills.motion import CONTROL_DT
from jaxskills.physics import servo
from jaxskills.physics.base import SimState, start

H = CONTROL_DT / 4


def random_states(who: Character, count: int) -> tuple[list[SimState], np.ndarray]:
    """Returns states, some far and fast, and targets `[count, nq]`."""
    rng = np.random.default_rng(0)
    rows = np.tile(tiny.standing(1)[0], (2, count, 1))
    for row in rows.reshape(-1, 13):
        mujoco.mj_integratePos(who.model, row, rng.normal(0, 0.5, who.layout.nv), 1.0)
    speeds = rng.normal(0, 6.0, (count, who.layout.nv))
    changes = rng.normal(0, 200.0, (count, who.layout.nv))
    states = [start(*x) for x in zip(rows[0], speeds, strict=True)]
    warm = [s.replace(qacc=jnp.float32(x)) for s, x in zip(states, changes, strict=True)]
    return warm, rows[1].astype(np.float32)


@pytest.mark.parametrize("h", [0.0, H])
def test_torques_at_the_end_of_a_step_are_within_their_limits(who: Character, h: float):
    servos, layout, dofs = servo.of(who), who.layout, np.array(who.actuated)
    states, targets = random_states(who, 200)
    seen = []
    for sim, target in zip(states, targets, strict=True):
        ctrl = servo.controls(servos, layout, sim, target, jnp.zeros(layout.nv), h)
        end = (sim.qvel + h * sim.qacc)[dofs]
        # Servos measure in rotation vectors, which the engine takes to grow with the velocity.
        now = pose.rotation_vectors(layout, sim.qpos)[dofs] + h * end
        torque = servos.kp * (ctrl - now) - servos.kd * end
        error = pose.minus(layout, jnp.asarray(target), sim.qpos)[dofs] - h * end
        seen.append((torque, servos.kp * error - servos.kd * end))
    torque, wanted = np.asarray(seen).swapaxes(0, 1)
    assert (np.abs(torque) <= np.asarray(servos.torque) * (1 + 1e-4)).all()
    # Where the limit does not bind, it is kp times the displacement to the target less kd v.
    free = np.abs(torque) < np.asarray(servos.torque) * (1 - 1e-3)
    assert 0.05 < free.mean() < 0.95
    np.testing.assert_allclose(torque[free], wanted[free], atol=1e-2)


def test_without_a_limit_the_guess_does_not_matter(who: Character):
    servos, still = servo.unlimited(servo.of(who)), jnp.zeros(who.layout.nv)
    for sim, target in zip(*random_states(who, 5), strict=True):
        guessed = servo.controls(servos, who.layout, sim, target, still, H)
        plain = servo.controls(servos, who.layout, sim.replace(qacc=still), target, still, 0.0)
        np.testing.assert_allclose(guessed, plain, atol=1e-5)


def test_the_reported_torque_is_the_engines(who: Character):
    model = character.compile(who, H)
    data = mujoco.MjData(model)
    servos = servo.of(who)
    for sim, target in zip(*random_states(who, 5), strict=True):
        ctrl = servo.controls(servos, who.layout, sim, target, jnp.zeros(who.layout.nv), H)
        data.qpos[:], data.qvel[:], data.ctrl[:] = sim.qpos, sim.qvel, ctrl
        mujoco.mj_forward(model, data)
        found = servo.applied_torque(servos, who.layout, sim.qpos, sim.qvel, ctrl)
        np.testing.assert_allclose(found, data.actuator_force, atol=2e-3)


@pytest.mark.parametrize("backend", ["cpu", "mjx"])
def test_the_warm_start_is_the_acceleration(who: Character, backend: str):
    """In a backend where it is anything else, guesses would be wrong."""
    engine = physics_lib.make(backend, 1, num_envs=1)
    model = engine.load([character.compile(who, H)])
    step, variant = jax.jit(engine.step), jnp.int32(0)
    sim = engine.init(model, variant, jnp.float32(tiny.standing(1)[0]), jnp.zeros(who.layout.nv))
    ctrl = jnp.float32([0.3, -0.2, 0.1, 0.5, -0.4])
    for _ in range(5):
        after = step(model, variant, sim, ctrl)
        change = (after.qvel - sim.qvel) / H
        np.testing.assert_allclose(change, after.qacc, rtol=1e-3, atol=0.05)
        sim = after
    assert np.abs(np.asarray(sim.qacc)[6:]).max() > 10.0


def test_a_push_is_worth_the_same_at_any_rate(who: Character):
    """A leg in the air is pushed as hard as it can be, for a tenth of a second.

    At 120 Hz it is as fast as at 2400 Hz. With a limit at the beginning of a step it would have
    little more than half of that speed.
    """
    rest, servos = jnp.zeros(who.layout.nv), servo.of(who)
    target = jnp.float32(tiny.standing(1)[0]).at[tiny.LEFT_HIP].add(2.0)
    speeds = []
    for substeps in (4, 80):
        h = CONTROL_DT / substeps
        engine, model = tiny.make_physics(who, substeps)
        lifted = jnp.float32(tiny.standing(1)[0]).at[2].add(1.0)
        sim = engine.init(model, jnp.int32(0), lifted, rest)

        def one(sim: SimState, _: None, h=h, engine=engine, model=model):
            ctrl = servo.controls(servos, who.layout, sim, target, rest, h)
            return engine.step(model, jnp.int32(0), sim, ctrl), sim.qvel[9]

        sim, _ = jax.lax.scan(one, sim, None, length=substeps)
        speeds.append(float(sim.qvel[9]))
    assert speeds[0] == pytest.approx(speeds[1], rel=0.1)
