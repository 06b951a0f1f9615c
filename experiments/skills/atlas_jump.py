# SPDX-License-Identifier: Apache-2.0
"""A human jump on Atlas by bounds alone, with the settings of `atlas_walk`."""

from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.explore.starts import StartsConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="atlas_jump",
    clip="jump",
    character="atlas",
    note="DeepMimic jump on a robot of 182 kg, hinges only, neither scaled nor slowed.",
    config=TrainConfig(
        starts=StartsConfig(segments=20),
        evolution=EvolutionConfig(enabled=True, elites=100),
    ),
)
