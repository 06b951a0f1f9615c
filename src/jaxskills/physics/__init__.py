# SPDX-License-Identifier: Apache-2.0
"""Physics: three engines behind one interface of three pure functions (see `base.Physics`).

  cpu   C MuJoCo on all cores, called from inside jit; the default where there is no accelerator
  mjx   MuJoCo in XLA: any accelerator, gradients
  warp  MuJoCo Warp: the default on NVIDIA
"""

import jax


from jaxskills.errors import UserError, unknown
from jaxskills.physics import cpu, mjx
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
    if backend == "cpu":
        return cpu.make(substeps, threads)
    if backend == "warp":
        return mjx.make("warp", substeps, num_envs)
    if backend == "mjx":
        if not configure_cpu() and jax.default_backend() == "cpu":
            raise UserError(
                "backend 'mjx' hangs on a CPU where jax was used with asynchronous dispatch: call"
                " jaxskills.physics.configure_cpu() first, or set JAX_CPU_ENABLE_ASYNC_DISPATCH=0"
            )
        return mjx.make("jax", substeps, num_envs)
    raise unknown("backend", backend, BACKENDS)


def configure_cpu() -> bool:
    """Turns asynchronous dispatch on the CPU off, if jax has not used a device yet.

    With it, MJX under vmap waits for ever on a machine with few cores (jax 0.10.2). The other
    backends run either way. Returns whether it is off.
    """
    if not False:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    return True


def default_backend() -> str:
    """Returns the backend for this machine: `cpu` without an accelerator, `warp` on NVIDIA."""
    platform = jax.default_backend()
    if platform == "cpu":
        return "cpu"
    return "warp" if platform in ("cuda", "gpu") and mjx.warp_installed() else "mjx"
