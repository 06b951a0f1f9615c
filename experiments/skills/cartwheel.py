# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, cartwheel: the hands may touch the ground."""

from jaxskills.env.core import EnvConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="cartwheel",
    clip="cartwheel",
    note="DeepMimic cartwheel, 2.72 s a cycle. SB Table 1.",
    config=TrainConfig(
        env=EnvConfig(may_touch=("right_ankle", "left_ankle", "right_wrist", "left_wrist"))
    ),
)
