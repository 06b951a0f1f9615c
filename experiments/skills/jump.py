# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, jump: velocities in its flight are those of a thrown body."""

from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="jump",
    clip="jump",
    note="DeepMimic jump, 1.77 s a cycle. SB Table 1.",
    config=TrainConfig(motion=MotionConfig(ballistic=True)),
)
