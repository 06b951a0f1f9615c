# SPDX-License-Identifier: Apache-2.0
"""A family of walks of the walker of four bodies, of which an update takes a moment."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tiny

from jaxskills import checkpoint, commands, recipes, variation
from jaxskills.compilation import jit
from jaxskills.explore.elites import Elites
from jaxskills.trainer import TrainConfig, Trainer, TrainState
from jaxskills.variation import Variation

_RECIPE = """
from jaxskills.env import conditions, measure
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.explore.curriculum import CurriculumConfig
from jaxskills.explore.elites import EliteConfig
from jaxskills.explore.family import FamilyConfig
from jaxskills.explore.marginal import MarginalConfig
from jaxskills.explore.parameterization import ParameterizationConfig
from jaxskills.explore.sampling import SamplingConfig
from jaxskills.learn.networks import NetworkConfig
from jaxskills.learn.ppo import PPOConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

HEIGHT = Parameter("height", (0.5, 1.5), measure=measure.at(0.5, measure.com_height))
GRAVITY = Parameter("gravity", (0.5, 2.0), condition=conditions.gravity)
FAMILY = FamilyConfig(
    episodes=1.0,
    elites=EliteConfig(capacity=64),
    parameterization=ParameterizationConfig(hidden=(8,), minibatch=8, steps=2),
    curriculum=CurriculumConfig(
        batch=4, sampling=SamplingConfig(candidates=64, pool=16, chains=4, thin=1)
    ),
    marginal=MarginalConfig(hidden=(8,), minibatch=8, steps=2),
)
RECIPE = Recipe(
    "walks",
    {clip!r},
    {character!r},
    TrainConfig(
        backend="cpu",
        envs=8,
        horizon=16,
        samples=1,
        env=EnvConfig(reward="tracking", time_warp=True),
        family=FAMILY,
        networks=NetworkConfig(policy=(16,), value=(16,)),
        ppo=PPOConfig(epochs=1, minibatch=64),
    ),
    TaskSpec((HEIGHT, GRAVITY)),
)
"""


def write_recipe(folder: Path) -> Path:
    """Writes `walks.py`, its clip and its character; returns the path of the first."""
    clip, character = tiny.write_clip(folder), tiny.write_character(folder)
    path = folder / "walks.py"
    path.write_text(_RECIPE.format(clip=str(clip), character=str(character)))
    return path


def config(folder: Path) -> TrainConfig:
    """Returns the settings of the recipe."""
    return commands.settings(recipes.find(str(write_recipe(folder))))


def trained(made: Trainer) -> TrainState:
    """Returns a state as if after a training: two elites, one lower and one higher than the walk.

    The policy is as at the beginning, near its feed-forward.
    """
    state = jit(made.init)(jax.random.key(0))
    family = state.family
    assert family is not None
    nv = made.character.layout.nv
    knots = family.elites.x.shape[1] // (nv + 1)
    itself = variation.zeros(knots, nv)
    for row, (a, lift) in enumerate((((0.2, 0.5), -0.02), ((0.8, 0.5), 0.04))):
        x = variation.flatten(Variation(itself.d.at[:, 2].set(lift), itself.tau))
        elites = family.elites
        elites = Elites(
            elites.a.at[row].set(jnp.array(a)),
            elites.x.at[row].set(x),
            elites.fitness.at[row].set(0.5 + 0.2 * row),
            elites.used.at[row].set(True),
        )
        family = dataclasses.replace(family, elites=elites)
    base = dataclasses.replace(family.base, learnt=jnp.bool_(True))
    family = dataclasses.replace(family, base=base, episodes=jnp.uint32(1234))
    return dataclasses.replace(state, family=family, samples=jnp.uint32(4096))


def write_run(run: Path, made: Trainer, state: TrainState) -> Path:
    """Writes the run folder of a state, with two lines of metrics; returns it."""
    run.mkdir(parents=True)
    checkpoint.write_config(run, made.config)
    checkpoint.save(run, state, int(state.samples))
    rows = [line(update) for update in (1, 2)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def line(update: int, **changes) -> dict[str, Any]:
    """Returns a line of a family's metrics.jsonl."""
    row = {"samples": 2048 * update, "wall_s": 10.0 * update, "survival_s": 1.0, "ended/root": 1.0}
    row |= {"episodes": 600 * update, "base_learnt": True, "success": 0.5, "fitness": 0.7}
    row |= {"explored": 0.1 * update, "marginal": 0.2, "refining": False, "elites": 2}
    return row | {"rate_around": 0.3, "rate_inside": 0.1} | changes
