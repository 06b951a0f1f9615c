# SPDX-License-Identifier: Apache-2.0
"""How much of a family's training goes into elites, parameterisation and curriculum.

    python benchmarks/family.py cartwheel_family [--elites 10000] [--repeats 5] [--json]

Fills the elite set with random elites, then times the whole jitted update, and beside it, in the
same run and from the same state, what is not rollout, physics or learning of the policy: finding
the whole episodes, the family's own update, and the compiling of bodies and physics on the host.
With --json the last line is one JSON object.
"""

import argparse
import dataclasses
import json
import shlex
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from train import take_turns

from jaxskills import commands, families, physics, provenance, recipes
from jaxskills.compilation import jit
from jaxskills.explore import elites as elites_lib
from jaxskills.explore.elites import Elites
from jaxskills.trainer import TrainConfig, TrainState


def crowded(state: TrainState, count: int) -> TrainState:
    """Returns the state as if the reference were learnt and `count` elites found."""
    family = state.family
    assert family is not None
    size, parameters = family.elites.x.shape[1], family.elites.a.shape[1]
    points = jnp.asarray(elites_lib.spread(count, parameters))
    motions = 0.01 * jax.random.normal(jax.random.key(0), (count, size))
    elites = Elites(points, motions, jnp.full(count, 0.5), jnp.ones(count, bool))
    base = dataclasses.replace(family.base, learnt=jnp.bool_(True))
    return dataclasses.replace(state, family=dataclasses.replace(family, elites=elites, base=base))


def parts(config: TrainConfig, count: int) -> dict[str, Callable[[], Any]]:
    """Returns the calls to time, each from the same state."""
    made = families.make(config)
    world_of = made.world
    assert world_of is not None
    own = families.parts(config, recipes.task(config.task))
    state = crowded(jit(made.init)(jax.random.key(config.seed)), count)
    update = jit(made.update)
    state, _ = update(state, world_of(state))  # which asks for what comes next
    now = world_of(state)
    key = jax.random.key(1)
    _, practice, _ = jit(
        lambda state, world: families.practise(own, made.networks, state, world, key)
    )(state, now)
    stock = jit(lambda state, world, done: families.take_stock(own, state, world, done, key))
    # Another batch each time: the same one would not be compiled again.
    batches = iter(jax.random.uniform(key, (1000, *state.family.asked.a.shape)))
    return {
        "update": lambda: update(state, now),
        "stock": lambda: stock(state, now, practice),
        "world": lambda: world_of(asking(state, next(batches))),
    }


def asking(state: TrainState, a: jax.Array) -> TrainState:
    """Returns the state that asks for `a [W, P]`."""
    family = state.family
    assert family is not None
    asked = dataclasses.replace(family.asked, a=a)
    return dataclasses.replace(state, family=dataclasses.replace(family, asked=asked))


def main() -> None:
    """Times and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("skill", nargs="?", default="cartwheel_family")
    parser.add_argument("--elites", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    physics.configure_cpu("cpu")
    config = commands.settings(recipes.find(options.skill))
    keep = dataclasses.replace(config.family.elites, capacity=options.elites)
    config = dataclasses.replace(config, family=dataclasses.replace(config.family, elites=keep))
    times = take_turns(parts(config, options.elites), options.repeats)
    median = {name: statistics.median(row) for name, row in times.items()}
    whole = median["update"] + median["world"]
    share = (median["stock"] + median["world"]) / whole
    result = {
        "skill": options.skill,
        "elites": options.elites,
        "overhead": share,
        "median_ms": {name: 1e3 * value for name, value in median.items()},
        "envs": config.envs,
        "command": shlex.join(["python", *sys.argv]),
        "repeats": options.repeats,
        **provenance.describe(Path(__file__).parent),
    }
    print(f"{share:.1%} of an update goes into elites, parameterisation, curriculum and compiling")
    for name, value in result["median_ms"].items():
        print(f"  {name:8} {value:8.1f} ms")
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
