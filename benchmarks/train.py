# SPDX-License-Identifier: Apache-2.0
"""How fast the whole training loop runs, and where its time goes.

    python benchmarks/train.py --clip walk [--envs 256] [--repeats 10] [--json]

Times the jitted update, and beside it, in the same run and over the same states, its rollout, the
physics of that rollout alone, and its learning alone. What is left of the rollout is observation,
bounds, policy and new starts. With --json the last line is one JSON object.
"""

import argparse
import dataclasses
import json
import shlex
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxskills import character as character_lib
from jaxskills import physics, provenance, trainer
from jaxskills.compilation import jit
from jaxskills.explore import starts as starts_lib
from jaxskills.learn import ppo, rollout
from jaxskills.motion import CONTROL_DT


def parts(config: trainer.TrainConfig) -> dict[str, Callable[[], Any]]:
    """Returns the calls to time, each on the same state."""
    made = trainer.make(config)
    state = jit(made.init)(jax.random.key(config.seed))
    update = jit(made.update)
    for _ in range(5):  # away from the very first poses
        state, _ = update(state)
    env, nets, current = made.env, made.networks, state.current
    assert current is not None
    key = jax.random.key(1)

    def roll(state: trainer.TrainState) -> Any:
        phase = starts_lib.sample(config.starts, state.starts, key, config.envs, env.length)
        fresh = rollout.begin(env, phase)
        return rollout.collect(
            env,
            nets,
            state.learner.policy,
            state.normalizer,
            current,
            fresh,
            key,
            config.horizon,
        )

    roll = jit(roll)
    _, steps = roll(state)

    def learn(state: trainer.TrainState, steps: rollout.Transition) -> Any:
        batch = trainer.to_batch(config.ppo, nets, state.learner, state.normalizer, steps)
        return ppo.update(config.ppo, nets, state.learner, batch, key)

    learn = jit(learn)
    step, sim = physics_only(config, made, current.state.sim)
    return {
        "update": lambda: update(state),
        "rollout": lambda: roll(state),
        "physics": lambda: step(sim),
        "learning": lambda: learn(state, steps),
    }


def physics_only(
    config: trainer.TrainConfig, made: trainer.Trainer, sim: Any
) -> tuple[Callable[[Any], Any], Any]:
    """Returns `horizon` physics steps of all environments under zero controls, and the states."""
    backend = physics.default_backend() if config.backend == "auto" else config.backend
    engine = physics.make(backend, config.env.substeps, num_envs=config.envs)
    timestep = CONTROL_DT / config.env.substeps
    model = engine.load([character_lib.compile(made.character, timestep)])
    ctrl = jnp.zeros((config.envs, made.env.action_size))
    variant = jnp.zeros(config.envs, jnp.int32)

    def run(sim: Any) -> Any:
        def advance(sim: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(engine.step, (None, 0, 0, 0))(model, variant, sim, ctrl), None

        return jax.lax.scan(advance, sim, None, length=config.horizon)[0]

    return jit(run), sim


def take_turns(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, list[float]]:
    """Returns the wall seconds of each call, `repeats` times, in turns, after one warm-up.

    Whatever else the machine does meanwhile hits all of them.
    """
    times = {name: [] for name in calls}
    for repeat in range(repeats + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            jax.block_until_ready(call())
            if repeat:
                times[name].append(time.perf_counter() - begin)
    return times


def main() -> None:
    """Times and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clip", default="walk")
    parser.add_argument("--envs", type=int, default=trainer.TrainConfig().envs)
    parser.add_argument("--horizon", type=int, default=trainer.TrainConfig().horizon)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    physics.configure_cpu("cpu")
    config = dataclasses.replace(
        trainer.TrainConfig(clip=options.clip), envs=options.envs, horizon=options.horizon
    )
    times = take_turns(parts(config), options.repeats)
    median = {name: statistics.median(row) for name, row in times.items()}
    count = config.envs * config.horizon
    shares = {
        "physics": median["physics"] / median["update"],
        "observation": (median["rollout"] - median["physics"]) / median["update"],
        "learning": median["learning"] / median["update"],
    }
    result = {
        "control_steps_per_s": count / median["update"],
        "control_steps_per_s_best": count / min(times["update"]),
        "shares": shares,
        "median_ms": {name: 1e3 * value for name, value in median.items()},
        "envs": config.envs,
        "horizon": config.horizon,
        "substeps": config.env.substeps,
        "command": shlex.join(["python", *sys.argv]),
        "repeats": options.repeats,
        **provenance.describe(Path(__file__).parent),
    }
    print(f"{result['control_steps_per_s']:.0f} control steps/s of the whole loop")
    for name, share in shares.items():
        print(f"  {name:12} {share:6.1%}")
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
