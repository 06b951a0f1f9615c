# SPDX-License-Identifier: Apache-2.0
"""Walk turn, SB fig. 11: the default settings, and the turn of a cycle is kept."""

from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="walk_turn",
    clip="walker/turn_left0",
    note="Turning walk of the pybullet walker set, 1.23 s a cycle.",
    config=TrainConfig(motion=MotionConfig(turn_with_cycle=True)),
)
