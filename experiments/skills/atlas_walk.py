# SPDX-License-Identifier: Apache-2.0
"""SB fig. 8: a human walk on Atlas by bounds alone; segments and elites as the authors had."""

from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.explore.starts import StartsConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="atlas_walk",
    clip="walk",
    character="atlas",
    note="DeepMimic walk on a robot of 182 kg, hinges only, neither scaled nor slowed. SB fig. 8.",
    config=TrainConfig(
        starts=StartsConfig(segments=20),
        evolution=EvolutionConfig(enabled=True, elites=100),
    ),
)
