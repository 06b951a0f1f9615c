# SPDX-License-Identifier: Apache-2.0
"""Physics: three engines behind one interface of three pure functions (see `base.Physics`).

- cpu: C MuJoCo on all cores, called from inside jit; the default where there is no accelerator
- mjx: MuJoCo in XLA: any accelerator, gradients
- warp: MuJoCo Warp: the default on NVIDIA
"""

import importlib.util
import os

import jax
from jax._src import xla_bridge  # nothing public tells whether jax has used a device already

from jaxskills.errors import UserError, unknown
from jaxskills.physics import cpu
from jaxskills.physics.base import Physics, SimState
from jaxskills.physics.cpu import usable_cores

__all__ = [
    "BACKENDS",
    "Physics",
    "SimState",
    "configure_cpu",
    "default_backend",
    "make",
    "usable_cores",
]

BACKENDS = ("cpu", "mjx", "warp")

POOL = 8
"""Threads that XLA's CPU pool needs for MJX."""


def make(backend: str, substeps: int, *, num_envs: int, threads: int | None = None) -> Physics:
    """Returns the physics of `backend`.

    Args:
      backend: one of `BACKENDS`.
      substeps: engine steps per control step; the engine's time step is the models'.
      num_envs: environments that are stepped at a time at most (sizes Warp's contact arrays).
      threads: of the cpu backend; None means all usable cores. The result does not depend on it.

    Raises:
      UserError: unknown backend, a number that is not positive, or a backend that cannot run here.
    """
    for name, value in (("substeps", substeps), ("num_envs", num_envs), ("threads", threads)):
        if value is not None and value < 1:
            raise UserError(f"physics {name} is {value}: give at least 1")
    if backend not in BACKENDS:
        raise unknown("backend", backend, BACKENDS)
    if backend == "cpu":
        return cpu.make(substeps, threads)
    if backend == "warp" and not _warp_installed():
        raise UserError("backend 'warp' needs warp-lang: run pip install 'mujoco-mjx[warp]'")
    if backend == "mjx" and not configure_cpu() and jax.default_backend() == "cpu":
        raise UserError(
            "backend 'mjx' can wait for ever on a CPU of few cores: call jaxskills.physics."
            f"configure_cpu() before jax is first used, or set the variable NPROC={POOL}"
        )
    from jaxskills.physics import mjx  # slow to import, and not needed by the other backend

    return mjx.make("warp" if backend == "warp" else "jax", substeps, num_envs)


def configure_cpu(backend: str = "mjx") -> bool:
    """Makes jax on the CPU fit for a backend, if it has not used a device yet.

    jaxlib's batched Cholesky factorisation runs on a thread of XLA's pool and waits there for
    tasks of the same pool: on two cores, two of them wait for each other for ever (jaxlib 0.10.2).
    So for `mjx` the pool gets `POOL` threads (variable NPROC); the others, which do without that
    factorisation, keep one thread per core, with which learning is a seventh faster. Asynchronous
    dispatch, which takes another thread, is turned off. Returns whether the pool is large enough
    for `mjx`.
    """
    pool = _pool_size()
    if not xla_bridge.backends_are_initialized():
        jax.config.update("jax_cpu_enable_async_dispatch", False)
        if backend == "mjx":
            os.environ["NPROC"] = str(max(pool, POOL))
    return _pool_size() >= POOL


def _pool_size() -> int:
    """Returns how many threads XLA's CPU pool has, or would have if it started now."""
    named = os.environ.get("NPROC", "")
    return int(named) if named.isdigit() and int(named) > 0 else usable_cores()


def default_backend() -> str:
    """Returns the backend for this machine: `cpu` without an accelerator, `warp` on NVIDIA."""
    platform = jax.default_backend()
    if platform == "cpu":
        return "cpu"
    return "warp" if platform in ("gpu", "cuda") and _warp_installed() else "mjx"


def _warp_installed() -> bool:
    return importlib.util.find_spec("warp") is not None
