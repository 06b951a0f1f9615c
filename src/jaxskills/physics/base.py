# SPDX-License-Identifier: Apache-2.0
"""The physics interface: what a state is, what a backend offers, and what divergence means.

A backend is three pure functions. They treat ONE environment; the caller vmaps them. Whatever an
engine does with a simulation that blows up (C MuJoCo silently resets it, MJX returns NaN), every
backend here does the same: the state stays at its last sound value and `diverged` is set.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import mujoco

from jaxskills.errors import UserError

LIMIT = 1e10
"""Largest magnitude of a sound coordinate, velocity or control (MuJoCo's own `mjMAXVAL`)."""


@flax.struct.dataclass
class SimState:
    """What an environment carries from one control step to the next.

    Attributes:
      qpos: [nq] float32, MuJoCo coordinates (m, rad, quaternions wxyz). Finite after a step.
      qvel: [nv] float32, velocities (m/s, rad/s). Finite after a step.
      qacc: [nv] float32, acceleration of the last physics step, from which the solver starts the
        next; 0 at first.
      diverged: [] bool, true once a step failed: qpos and qvel are then those before it, not a
        simulation. It stays true until `init`.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc: jax.Array
    diverged: jax.Array


class Physics(NamedTuple):
    """A backend.

    Attributes:
      load: (mj_models) -> model. W >= 1 compiled models of equal sizes, one per variant; the result
        is a pytree that may be passed through jit. Runs on the host.
      init: (model, variant, qpos, qvel) -> SimState, with a zero warm start. variant is int32 [].
      step: (model, variant, state, ctrl) -> SimState, `substeps` engine steps under constant ctrl
        [nu]. The same inputs give the same bits, whatever ran before.
    """

    load: Callable[..., Any]
    init: Callable[..., SimState]
    step: Callable[..., SimState]


def start(qpos: jax.Array, qvel: jax.Array) -> SimState:
    """Returns a fresh state: [nq] and [nv] as float32, no warm start, not diverged."""
    qvel = jnp.asarray(qvel, jnp.float32)
    return SimState(
        qpos=jnp.asarray(qpos, jnp.float32),
        qvel=qvel,
        qacc=jnp.zeros_like(qvel),
        diverged=jnp.zeros((), bool),
    )


def sound(*vectors: jax.Array) -> jax.Array:
    """Returns [] bool: every entry is finite and below `LIMIT` in magnitude."""
    return jnp.stack([jnp.all(jnp.abs(v) < LIMIT) for v in vectors]).all()


def admit(home: jax.Array, state: SimState, ctrl: jax.Array) -> tuple[SimState, jax.Array]:
    """Returns (state, ctrl) fit for an engine: unsound input becomes `home` [nq] at rest, ctrl 0.

    The returned state is marked as diverged where anything was replaced.
    """
    ok = sound(state.qpos, state.qvel, state.qacc)
    commanded = sound(ctrl)
    admitted = SimState(
        qpos=jnp.where(ok, state.qpos, home),
        qvel=jnp.where(ok, state.qvel, 0.0),
        qacc=jnp.where(ok, state.qacc, 0.0),
        diverged=state.diverged | ~ok | ~commanded,
    )
    return admitted, jnp.where(commanded, ctrl, 0.0)


def settle(before: SimState, after: SimState) -> SimState:
    """Returns `after`, or `before` marked as diverged where either of them is unsound."""
    ok = sound(after.qpos, after.qvel, after.qacc) & ~after.diverged & ~before.diverged
    kept = jax.tree.map(lambda new, old: jnp.where(ok, new, old), after, before)
    return kept.replace(diverged=~ok)


def check(models: Sequence[mujoco.MjModel]) -> None:
    """Makes sure that W models can be the variants of one simulation.

    Raises:
      UserError: no model, unequal sizes or time steps, or state that a `SimState` does not carry.
    """
    if not models:
        raise UserError("physics models: got none, give at least one")
    for field in ("nq", "nv", "nu", "nbody", "ngeom", "nmocap", "neq", "npair"):
        sizes = sorted({getattr(model, field) for model in models})
        if len(sizes) > 1:
            raise UserError(f"physics models differ in {field}: {sizes}, make them equal")
    for field in ("na", "nplugin", "nhistory"):
        size = max(getattr(model, field, 0) for model in models)
        if size:
            raise UserError(f"physics model has {field} = {size}: only models with 0 are supported")
