# SPDX-License-Identifier: Apache-2.0
"""SB fig. 9 and 13, the first 4 s of a break dance: starts evolve; the clip is the user's own."""

from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.explore.starts import StartsConfig
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="break_dance",
    clip="break_dance",
    note="humanoid3d_break_dance.txt from a folder named by JAXSKILLS_CLIP_DIR. Does not loop.",
    config=TrainConfig(
        motion=MotionConfig(end=4.0),
        starts=StartsConfig(segments=20),
        evolution=EvolutionConfig(enabled=True),
    ),
)
