# SPDX-License-Identifier: Apache-2.0
"""C MuJoCo on all cores, called from inside jit.

The whole vmapped batch becomes one call of `mujoco.batch.Batch`, whose result does not depend on
the number of threads. A loaded set of models is named by a small integer derived from its content,
so a program compiled in one process is found in the compilation cache by the next.
"""

import collections
import dataclasses
import functools
import hashlib
import os
import threading
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from jaxskills.physics import ffi, quiet
from jaxskills.physics.base import Physics, SimState, admit, check, settle, start

TARGET = "jaxskills_mujoco_step"

CALLBACK_VARIABLE = "JAXSKILLS_CPU_CALLBACK"
"""Environment variable: set to 1, physics goes through `jax.pure_callback` (slower)."""

KEPT = 16
"""Sets of models kept in memory at most; the least recently used one goes first."""


@flax.struct.dataclass
class CpuModel:
    """A loaded set of models. handle: int32 [], its name. home: [W, nq] float32, their `qpos0`."""

    handle: jax.Array
    home: jax.Array


@dataclasses.dataclass
class _Runner:
    """A batch of one size, the state row of each variant, and who runs what at present."""

    batch: Batch
    rows: np.ndarray
    views: tuple[np.ndarray, ...]
    assigned: np.ndarray
    lock: threading.Lock


@dataclasses.dataclass
class _Simulator:
    """A set of models and the batches that run them, one for each batch size asked for."""

    digest: bytes
    models: tuple[mujoco.MjModel, ...]
    threads: int
    runners: dict[int, _Runner]
    lock: threading.Lock


_simulators: collections.OrderedDict[int, _Simulator] = collections.OrderedDict()
_registry = threading.Lock()


def usable_cores() -> int:
    """Returns how many cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def load(models: Sequence[mujoco.MjModel], threads: int) -> CpuModel:
    """Takes W models of equal sizes into memory; the same models again give the same handle.

    Raises:
      UserError: no model, models of unequal sizes, or state that a `SimState` does not carry.
    """
    check(models)
    quiet.silence()
    hashed = hashlib.sha256(str(threads).encode())
    for model in models:
        content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        hashed.update(content.data)
    digest = hashed.digest()
    handle = int.from_bytes(digest[:4], "big") >> 1
    with _registry:
        while handle in _simulators and _simulators[handle].digest != digest:
            handle = (handle + 1) % 2**31
        if handle not in _simulators:
            _simulators[handle] = _Simulator(digest, tuple(models), threads, {}, threading.Lock())
        _simulators.move_to_end(handle)
        while len(_simulators) > KEPT:
            _simulators.popitem(last=False)
    home = np.stack([model.qpos0 for model in models])
    return CpuModel(jnp.asarray(handle, jnp.int32), jnp.asarray(home, jnp.float32))


def _runner(simulator: _Simulator, count: int) -> _Runner:
    with simulator.lock:
        if count not in simulator.runners:
            models = simulator.models
            batch = Batch(models[0], count, min(simulator.threads, count))
            rows = []
            for model in models:
                row = np.empty(batch.nstate)
                mujoco.mj_getState(
                    model, mujoco.MjData(model), row, mujoco.mjtState.mjSTATE_INTEGRATION
                )
                rows.append(row)
            names = ("qpos", "qvel", "qacc_warmstart", "ctrl", "time")
            simulator.runners[count] = _Runner(
                batch=batch,
                rows=np.stack(rows),
                views=tuple(batch.bind(name) for name in names),
                assigned=np.full(count, -1, np.int32),
                lock=threading.Lock(),
            )
        return simulator.runners[count]


def _advance(inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
    """Steps a batch: job, variant, qpos, qvel, warm start, ctrl -> qpos, qvel, warm start, failed.

    job [..., 2] holds the handle and the number of substeps, the same in every row. Any number of
    leading axes. A warning counter that starts at 1 keeps MuJoCo from printing and logging, and
    any counter that is not 1 afterwards tells of a warning, or of the silent reset it causes.
    """
    handle, substeps = (int(x) for x in inputs[0].reshape(-1, 2)[0])
    if (inputs[0] != (handle, substeps)).any():
        raise ValueError("one call mixes several loaded sets of models: do not vmap over the model")
    with _registry:
        simulator = _simulators.get(handle)
        if simulator is None:
            raise ValueError(
                f"the physics model {handle} is not in memory: load it in this process, and keep at"
                f" most {KEPT} in use at a time"
            )
        _simulators.move_to_end(handle)
    count = inputs[1].size
    runner = _runner(simulator, count)
    with runner.lock:
        _assign(runner, simulator.models, inputs[1].reshape(count))
        for view, value in zip(runner.views, inputs[2:], strict=False):
            view[...] = value.reshape(view.shape)
        runner.views[-1][...] = 0.0
        runner.batch.warning[...] = 1
        try:
            runner.batch.step(nstep=substeps)
        except SimulationError:
            pass  # the rows concerned have a status other than 0
        with np.errstate(over="ignore", invalid="ignore"):
            for view, value in zip(runner.views, outputs[:3], strict=False):
                value.reshape(view.shape)[...] = view
        failed = (runner.batch.warning != 1).any(axis=(1, 2)) | (runner.batch.status != 0)
        outputs[3].reshape(count)[...] = failed


def _assign(runner: _Runner, models: tuple[mujoco.MjModel, ...], variant: np.ndarray) -> None:
    """Makes row i of the batch run models[variant[i]]."""
    if np.array_equal(runner.assigned, variant):
        return
    if variant.min() < 0 or variant.max() >= len(models):
        raise ValueError(f"variant {variant} is outside 0..{len(models) - 1}")
    if len(models) > 1:
        runner.batch.set_models([models[i] for i in variant])
    runner.batch.state[...] = runner.rows[variant]
    runner.assigned[...] = variant


def _call(job, variant, state: SimState, ctrl, use_ffi: bool) -> SimState:
    outputs = [
        jax.ShapeDtypeStruct(x.shape, jnp.float32) for x in (state.qpos, state.qvel, state.qacc)
    ]
    outputs.append(jax.ShapeDtypeStruct((), jnp.bool_))
    arguments = (job, jnp.asarray(variant, jnp.int32), state.qpos, state.qvel, state.qacc, ctrl)
    if use_ffi:
        function = jax.ffi.ffi_call(TARGET, outputs, vmap_method="broadcast_all")
        return SimState(*function(*arguments))
    return SimState(*jax.pure_callback(_host, outputs, *arguments, vmap_method="broadcast_all"))


def _host(*arguments) -> list[np.ndarray]:
    inputs = [np.asarray(a) for a in arguments]
    lead = inputs[1].shape
    outputs = [np.empty(x.shape, np.float32) for x in inputs[2:5]] + [np.empty(lead, np.bool_)]
    _advance(inputs, outputs)
    return outputs


def make(substeps: int, threads: int | None) -> Physics:
    """Returns the cpu backend; threads None means all usable cores."""
    forced = os.environ.get(CALLBACK_VARIABLE) == "1"
    use_ffi = not forced and ffi.register(TARGET, _advance)

    def step(model: CpuModel, variant: jax.Array, state: SimState, ctrl: jax.Array) -> SimState:
        job = jnp.stack([model.handle, jnp.int32(substeps)])
        ctrl = jnp.asarray(ctrl, jnp.float32)
        before, ctrl = admit(model.home[variant], state, ctrl)
        return settle(before, _call(job, variant, before, ctrl, use_ffi))

    return Physics(
        load=functools.partial(load, threads=threads or usable_cores()),
        init=lambda model, variant, qpos, qvel: start(qpos, qvel),
        step=step,
    )
