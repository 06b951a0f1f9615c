# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, ObstacleJump: the height of what one jumps over.

A hurdle 10 cm thick stands where the feet of the clip are highest, 0.22 m. It is 0.15 m high, which
they clear by 5 cm. Its height is a condition, nothing is measured but that one gets about as far as
the reference: a jump that ends in front of the hurdle, or on it, does not count.
"""

from jaxskills.env import measure, obstacles
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

RECIPE = Recipe(
    name="obstacle_jump_family",
    clip="jump",
    note="A jump of 1.07 m over a hurdle of 0.15 m in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "height",
                (0.9, 3.0),
                condition=obstacles.box((0.55, 0.0), (0.1, 1.2), 0.15, "hurdle"),
            ),
            Parameter(
                "across",
                (1.0, 1.0),
                measure=measure.at(0.98, measure.along("root", (1.0, 0.0, 0.0))),
                sigma=0.25,  # 0.8 m at least: with both feet behind the hurdle
                strict=True,
            ),
        )
    ),
    # After the landing one stands, instead of crouching for the next jump.
    config=for_family(TrainConfig(motion=MotionConfig(loop=False))),
)
