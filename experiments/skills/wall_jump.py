# SPDX-License-Identifier: Apache-2.0
"""Vaulting over a wall with both hands on it: the reference of `wall_jump_family` alone."""

from jaxskills.env import obstacles
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="wall_jump",
    clip="wall_jump",
    note="Our own clip; the wall is 0.9 m high and 0.2 m thick.",
    task=TaskSpec(scenery=(obstacles.box((1.4, 0.0), (0.2, 1.2), 0.9, "wall"),)),
    config=TrainConfig(
        env=EnvConfig(may_touch=("left_ankle", "right_ankle", "left_wrist", "right_wrist"))
    ),
)
