# SPDX-License-Identifier: Apache-2.0
"""Physics speed: the backends inside jit against a bare C `mj_step` loop on the same cores.

    python benchmarks/physics.py --character humanoid34 --envs 64 --json

Every path starts from the same states and gets the same controls; the paths take turns, so that
whatever else the machine does hits all of them. A step is one engine step of one environment.
With --json the last line is one JSON object; `cpu_over_bare` is a ratio of the best times.
"""

import argparse
import json
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch, rollout

from jaxskills import character, physics, provenance
from jaxskills.compilation import jit


def states(model: mujoco.MjModel, envs: int, steps: int) -> tuple[np.ndarray, ...]:
    """Returns float32 qpos [B, nq], qvel [B, nv] near the zero pose and ctrl [K, B, nu]."""
    random = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (envs, 1))
    for row in qpos:
        mujoco.mj_integratePos(model, row, random.normal(size=model.nv) * 0.05, 1.0)
    qvel = random.normal(size=(envs, model.nv)) * 0.1
    ctrl = random.normal(size=(steps, envs, model.nu)) * 0.1
    return tuple(np.asarray(x, np.float32) for x in (qpos, qvel, ctrl))


def bare_loop(model, substeps: int, threads: int, qpos, qvel, ctrl) -> Callable[[], None]:
    """Returns a run of `mj_step` in C, one thread per core, nothing in between."""
    state = np.zeros((len(qpos), mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    state[:, 1 : 1 + model.nq + model.nv] = np.concatenate([qpos, qvel], axis=1)
    control = np.repeat(np.swapaxes(ctrl, 0, 1), substeps, axis=1).astype(float)
    pool = rollout.Rollout(nthread=threads)
    datas = [mujoco.MjData(model) for _ in range(threads)]
    chunk = max(1, len(qpos) // (4 * threads))

    def run() -> None:
        pool.rollout(model, datas, state, control, chunk_size=chunk)

    return run


def batch_loop(model, substeps: int, threads: int, qpos, qvel, ctrl) -> Callable[[], None]:
    """Returns a run of `mujoco.batch` from Python, control by control."""
    simulations = batch.Batch(model, len(qpos), threads)
    views = [simulations.bind(name) for name in ("qpos", "qvel", "qacc_warmstart", "ctrl")]

    def run() -> None:
        views[0][...], views[1][...], views[2][...] = qpos, qvel, 0.0
        for control in ctrl:
            views[3][...] = control
            simulations.step(nstep=substeps)

    return run


def jit_loop(backend: str, model, substeps: int, qpos, qvel, ctrl) -> Callable[[], None]:
    """Returns a run of a backend inside one jitted `lax.scan`, compiled already."""
    engine = physics.make(backend, substeps, num_envs=len(qpos))
    loaded = engine.load([model])
    variant = jnp.zeros(len(qpos), jnp.int32)

    @jit
    def advance(loaded, qpos, qvel, ctrl):
        state = jax.vmap(engine.init, (None, 0, 0, 0))(loaded, variant, qpos, qvel)
        step = jax.vmap(engine.step, (None, 0, 0, 0))
        end, _ = jax.lax.scan(lambda s, u: (step(loaded, variant, s, u), None), state, ctrl)
        return end

    arrays = [jnp.asarray(x) for x in (qpos, qvel, ctrl)]

    def run() -> None:
        end = jax.block_until_ready(advance(loaded, *arrays))
        if bool(end.diverged.any()):
            raise RuntimeError(f"{backend}: {int(end.diverged.sum())} environments diverged")

    run()
    return run


def take_turns(runs: dict[str, Callable[[], None]], repeats: int) -> dict[str, list[float]]:
    """Returns wall seconds of each run, `repeats` times, in turns, after one warm-up."""
    seconds = {name: [] for name in runs}
    for repeat in range(repeats + 1):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            if repeat:
                seconds[name].append(time.perf_counter() - begin)
    return seconds


def measure(args: argparse.Namespace) -> dict:
    """Returns the result as a JSON-ready dict."""
    physics.configure_cpu()
    model = character.load(args.character).model
    threads = args.threads or physics.usable_cores()
    result = {
        "character": args.character,
        "envs": args.envs,
        "threads": threads,
        "substeps": args.substeps,
        "timestep_s": model.opt.timestep,
        "nv": model.nv,
        "repeats": args.repeats,
        "command": shlex.join(["python", *sys.argv]),
        **provenance.describe(Path(__file__).parent),
    }

    def compare(backends: list[str], envs: int, steps: int, repeats: int) -> None:
        start = states(model, envs, steps)
        runs = {"bare": bare_loop(model, args.substeps, threads, *start)}
        runs["batch"] = batch_loop(model, args.substeps, threads, *start)
        for name in backends:
            runs[name] = jit_loop(name, model, args.substeps, *start)
        total = envs * steps * args.substeps
        seconds = take_turns(runs, repeats)
        for name in backends:
            result[f"{name}_over_bare"] = min(seconds["bare"]) / min(seconds[name])
            result[f"{name}_over_bare_median"] = statistics.median(
                bare / own for bare, own in zip(seconds["bare"], seconds[name], strict=True)
            )
            result[f"{name}_over_batch"] = min(seconds["batch"]) / min(seconds[name])
        for name in (["bare", "batch"] if "cpu" in backends else []) + backends:
            result[f"{name}_steps_per_s"] = total / min(seconds[name])
            result[f"{name}_steps_per_s_median"] = total / statistics.median(seconds[name])

    compare(["cpu"], args.envs, args.steps, args.repeats)
    if args.mjx:
        compare(["mjx"], args.mjx_envs, args.mjx_steps, 3)
    return result


def main() -> None:
    """Parses the command line, measures and prints."""
    parser = argparse.ArgumentParser(description="Times the physics backends.")
    parser.add_argument("--character", default="humanoid34", help="shipped name or MJCF file")
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=60, help="control steps per run")
    parser.add_argument("--substeps", type=int, default=4)
    parser.add_argument("--threads", type=int, default=0, help="0: all usable cores")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--mjx", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--mjx-envs", type=int, default=64)
    parser.add_argument("--mjx-steps", type=int, default=4)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    result = measure(args)
    for key, value in result.items():
        print(f"{key:28} {value:.4g}" if isinstance(value, float) else f"{key:28} {value}")
    if args.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
