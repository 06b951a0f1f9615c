# SPDX-License-Identifier: Apache-2.0
"""MJX, MuJoCo in XLA: `impl='jax'` for any accelerator, `impl='warp'` for NVIDIA.

Both carry the same small state as the cpu backend: what else MJX keeps in its Data follows from
coordinates, velocities and warm start, so it is rebuilt from a template at each control step.
"""

import contextlib
import copy
import dataclasses
import functools
import importlib
import io
from collections.abc import Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch

from jaxskills.errors import UserError
from jaxskills.physics import explicit
from jaxskills.physics.base import Physics, SimState, admit, check, settle, start

with contextlib.redirect_stdout(io.StringIO()):  # it prints where warp-lang is missing
    from mujoco import mjx

    from jaxskills.physics import box_floor

ITERATIONS = (6, 10)
"""Largest numbers of solver and line search iterations of `impl='jax'`: on a flailing humanoid the
result is that of (100, 50), in 40 % of the time."""

OVERFLOW = 0b11111
"""Warp's overflow bits that mean lost contacts or constraint rows (`OverflowType`, NEFC to CCD)."""

MARGIN = 2
"""Contact and constraint capacity for Warp, as a multiple of what a C rollout reached."""


@flax.struct.dataclass
class MjxModel:
    """A loaded set of W models.

    Attributes:
      shared: (mjx.Model, mjx.Data) of the first one; the Data is a template.
      varied: [W, ...] each, the leaves of `shared` that differ between the models.
      where: their positions among the leaves of `shared`.
      home: [W, nq] float32, `qpos0` of each.
    """

    shared: tuple[mjx.Model, mjx.Data]
    varied: tuple[jax.Array, ...]
    home: jax.Array
    where: tuple[int, ...] = flax.struct.field(pytree_node=False)


def load(models: Sequence[mujoco.MjModel], impl: str, num_envs: int) -> MjxModel:
    """Puts W models of equal sizes on the device and stacks what differs between them.

    Raises:
      UserError: no model, unequal sizes, a feature MJX lacks, or a difference that it cannot vary.
    """
    check(models)
    sizes = capacity(models, num_envs) if impl == "warp" else {}
    try:
        worlds = [_put(_prepare(model, impl), impl, sizes) for model in models]
    except NotImplementedError as error:
        raise UserError(f"backend with impl '{impl}' cannot run this model: {error}") from None
    leaves = [jax.tree.leaves(world) for world in worlds]
    for world in worlds[1:]:
        if jax.tree.structure(world) != jax.tree.structure(worlds[0]):
            field = _static_difference(worlds[0][0], world[0]) or "their sizes"
            raise UserError(
                f"physics models differ in {field}, which MJX compiles in: vary masses, sizes,"
                " positions, gains, gravity or friction"
            )
    columns = [[np.asarray(leaf) for leaf in column] for column in zip(*leaves, strict=True)]
    where = tuple(
        i for i, column in enumerate(columns) if any((x != column[0]).any() for x in column)
    )
    return MjxModel(
        # MJX ties its arrays to a device. Mixed with arrays that are not, a second call of a jitted
        # step would differ from the first in that alone, and compile again.
        shared=jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), worlds[0]),
        varied=tuple(jnp.asarray(np.stack(columns[i])) for i in where),
        home=jnp.asarray(np.stack([m.qpos0 for m in models]), jnp.float32),
        where=where,
    )


def _put(model: mujoco.MjModel, impl: str, sizes: dict[str, Any]) -> tuple[Any, mjx.Data]:
    """Returns the model on the device, and a Data of it."""
    placed = mjx.put_model(model, impl=impl)
    if impl == "jax" and model.nhfield == 0:  # sizes of geoms that only height fields compile in
        placed = placed.tree_replace({"_impl.geom_rbound_hfield": np.zeros(model.ngeom)})
    if impl == "warp":  # it would print from the device; `_advance_warp` reports instead
        placed = placed.tree_replace({"opt._impl.warn_overflow": 0})
    return placed, mjx.make_data(model, impl=impl, **sizes)


def _prepare(model: mujoco.MjModel, impl: str) -> mujoco.MjModel:
    """Returns a copy that MJX accepts.

    Warp refuses the flag that turns the reset of C MuJoCo off. `impl='jax'` has no `discrete`, and
    in float32 its solver seldom sees that it is done: every environment waits for the last.
    """
    if impl == "jax" and model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
        model = explicit.from_discrete(model)
    model = copy.copy(model)
    if impl == "jax":
        model.opt.iterations = min(model.opt.iterations, ITERATIONS[0])
        model.opt.ls_iterations = min(model.opt.ls_iterations, ITERATIONS[1])
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return model


def _static_difference(one: Any, other: Any) -> str | None:
    """Returns the name of a field that is no array on the device and differs, if there is one."""
    for field in dataclasses.fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(a):
            name = _static_difference(a, b)
            if name:
                return name
        elif not isinstance(a, jax.Array) and not np.array_equal(a, b):
            return field.name
    return None


def capacity(models: Sequence[mujoco.MjModel], num_envs: int) -> dict[str, int]:
    """Returns Warp's array sizes: `naconmax` contacts in all, `njmax` constraint rows per world.

    Bodies are thrown on the floor in C for a second; `MARGIN` times the most they needed, rounded
    up to a power of two, so that other variants of a character fit the same program.
    """
    contacts, rows = 8, 32
    random = np.random.default_rng(0)
    for model in models[:8]:
        drop = batch.Batch(model, 16)
        drop.warning[...] = 1
        qpos, qvel = drop.bind("qpos"), drop.bind("qvel")
        for pose in qpos:
            mujoco.mj_integratePos(model, pose, random.normal(size=model.nv), 1.0)
        qvel[...] = random.normal(size=qvel.shape)
        ncon, nefc = drop.bind("ncon"), drop.bind("nefc")
        for _ in range(int(1.0 / model.opt.timestep)):
            drop.step()
            contacts, rows = max(contacts, ncon.max()), max(rows, nefc.max())
    contacts, rows = (1 << (MARGIN * int(x) - 1).bit_length() for x in (contacts, rows))
    return {"naconmax": contacts * num_envs, "njmax": rows}


def _world(model: MjxModel, variant: jax.Array) -> tuple[mjx.Model, mjx.Data]:
    """Returns the model and the template of one variant."""
    leaves, structure = jax.tree.flatten(model.shared)
    for i, stacked in zip(model.where, model.varied, strict=True):
        leaves[i] = stacked[variant]
    return jax.tree.unflatten(structure, leaves)


def _advance(world: tuple[mjx.Model, mjx.Data], state: SimState, ctrl: Any, substeps: int):
    model, template = world

    def substep(_, carry):
        qpos, qvel, warmstart = carry
        data = template.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=ctrl)
        with box_floor.installed():
            data = mjx.step(model, data)
        return data.qpos, data.qvel, data.qacc_warmstart

    end = jax.lax.fori_loop(0, substeps, substep, (state.qpos, state.qvel, state.qacc))
    return SimState(*end, diverged=jnp.zeros((), bool))


def _advance_warp(world: tuple[mjx.Model, mjx.Data], state: SimState, ctrl: Any, substeps: int):
    """Steps Warp's own Data, since its buffers are better kept than filled anew each substep."""
    model, data = world
    data = data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc, ctrl=ctrl)
    overflow = jnp.zeros((), bool)
    for _ in range(substeps):
        data = mjx.step(model, data)
        overflow |= (data._impl.overflow & OVERFLOW) != 0
    return SimState(data.qpos, data.qvel, data.qacc_warmstart, diverged=overflow)


def _quiet_warp() -> None:
    """Keeps Warp from printing each kernel it compiles: standard output belongs to the user."""
    warp = importlib.import_module("warp")
    warp.config.log_level = warp.LOG_WARNING


def make(impl: str, substeps: int, num_envs: int) -> Physics:
    """Returns the mjx (`impl='jax'`) or the warp backend."""
    if impl == "warp":
        _quiet_warp()
    advance = _advance_warp if impl == "warp" else _advance

    def step(model: MjxModel, variant: jax.Array, state: SimState, ctrl: jax.Array) -> SimState:
        ctrl = jnp.asarray(ctrl, jnp.float32)
        before, ctrl = admit(model.home[variant], state, ctrl)
        return settle(before, advance(_world(model, variant), before, ctrl, substeps))

    return Physics(
        load=functools.partial(load, impl=impl, num_envs=num_envs),
        init=lambda model, variant, qpos, qvel: start(qpos, qvel),
        step=step,
    )
