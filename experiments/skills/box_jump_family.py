# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, BoxJump: how far and how high, or deep, one jumps.

Above 0 one jumps onto a box of that height (m), below 0 off a box of it. The box to jump onto
begins 10 cm before the heels of the clip land, and as much further away as the jump is longer; the
one to jump off ends 7 cm ahead of the toes. Both parameters set up the boxes and are measured
besides, as how far the centre of mass gets and how much it rises or falls: whoever lands short of
the box has jumped another distance on level ground.
"""

from jaxskills.env import measure, obstacles
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

_FAR = 1.07  # m that the clip jumps
_BEGIN, _END = 0.01, 1.0  # shares of the clip, in the same pose
_FIRST = obstacles.box((-0.94, 0.0), (2.12, 1.2), 0.0, "first")  # up to x = 0.12
_SECOND = obstacles.box((2.15, 0.0), (2.5, 1.2), 0.0, "second")  # from x = 0.9

RECIPE = Recipe(
    name="box_jump_family",
    clip="jump",
    note="A jump of 1.07 m on level ground in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "distance",
                (1.0, 2.15),
                measure=measure.change(measure.com_along((1.0, 0.0, 0.0)), _BEGIN, _END),
                condition=obstacles.moved("second", (_FAR, 0.0)),
            ),
            Parameter(
                "height",
                (-0.9, 0.9),
                measure=measure.change(measure.com_height, _BEGIN, _END),
                condition=obstacles.step("first", "second"),
                relative=False,
            ),
        ),
        scenery=(_FIRST, _SECOND),
    ),
    # After the landing one stands, instead of crouching for the next jump.
    config=for_family(TrainConfig(motion=MotionConfig(loop=False))),
)
