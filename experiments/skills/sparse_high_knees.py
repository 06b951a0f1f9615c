# SPDX-License-Identifier: Apache-2.0
"""SB fig. 7: jogging with high knees from four key poses, a poor reference: starts evolve."""

from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="sparse_high_knees",
    clip="sparse_high_knees",
    note="Authored here, 0.80 s a cycle. SB fig. 7.",
    config=TrainConfig(evolution=EvolutionConfig(enabled=True)),
)
