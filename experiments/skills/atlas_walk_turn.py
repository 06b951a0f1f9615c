# SPDX-License-Identifier: Apache-2.0
"""A turning human walk on Atlas by bounds alone, with the settings of `atlas_walk`."""

import dataclasses

from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe, find
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="atlas_walk_turn",
    clip="walker/turn_left0",
    character="atlas",
    note="Turning walk of the pybullet walker set on a robot of 182 kg, neither scaled nor slowed.",
    config=dataclasses.replace(
        find("atlas_walk").config or TrainConfig(), motion=MotionConfig(turn_with_cycle=True)
    ),
)
