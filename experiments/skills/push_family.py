# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Push: how heavy the box is."""

from jaxskills.env import measure, push
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

# With friction 0.3, as in the clip, 180 kg need 530 N: more than the feet of 45 kg hold, 400 N.
BOX = push.Box(("right_wrist", "left_wrist"), begin=0.15, end=0.81, face=0.65, friction=0.15)

RECIPE = Recipe(
    name="push_family",
    clip="push",
    note="A box of 18 kg, pushed by 1.2 m in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter("mass", (0.5, 10.0), condition=push.mass(BOX)),
            # A constraint: it goes as far, however heavy it is.
            Parameter("distance", (1.0, 1.0), measure=measure.at(0.9, push.travel(BOX))),
        ),
        objects=(push.box(BOX),),
    ),
    config=for_family(),
)
