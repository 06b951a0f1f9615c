# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, WallJump: the height of a wall that one vaults over, hands on it.

The wall is that of the clip, 0.9 m high and 0.2 m thick. Its height is a condition. That the hands
are on the wall when they are in the clip is part of the fitness, which compares how far hands and
feet are above the ground; a performance has to get as far as the reference to count.
"""

from jaxskills.env import measure, obstacles
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

_TOUCH = "left_ankle", "right_ankle", "left_wrist", "right_wrist"

RECIPE = Recipe(
    name="wall_jump_family",
    clip="wall_jump",
    note="A vault over a wall of 0.9 m in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "height",
                (0.9, 2.0),
                condition=obstacles.box((1.4, 0.0), (0.2, 1.2), 0.9, "wall"),
            ),
            Parameter(
                "across",
                (1.0, 1.0),
                measure=measure.at(0.98, measure.along("root", (1.0, 0.0, 0.0))),
                sigma=0.15,  # 1.7 m at least: with both feet behind the wall
                strict=True,
            ),
        )
    ),
    config=for_family(TrainConfig(env=EnvConfig(may_touch=_TOUCH))),
)
