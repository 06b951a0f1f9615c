# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Swing: the height of a block that one swings over, hanging from a bar.

FS does not say what its obstacle is. Here it is a block on the floor: 1.55 times as high, 0.47 m,
it makes the legs go higher, while a bar 1.55 times as high, 3.6 m, is out of reach for anybody. The
block stands between the places where the feet leave and land, and is 0.3 m high, which they clear
by 7 cm. Its height is a condition; a performance has to get as far as the reference to count.
"""

from jaxskills.env import measure, obstacles
from jaxskills.env.holds import Grip
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

_GRIP = Grip(("left_wrist", "right_wrist"), begin=0.335, end=0.565)

RECIPE = Recipe(
    name="swing_family",
    clip="swing",
    note="A swing at a bar 2.3 m high, over a block of 0.3 m in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "height",
                (1.0, 1.55),
                condition=obstacles.box((0.75, 0.0), (0.5, 1.2), 0.3, "block"),
            ),
            Parameter(
                "across",
                (1.0, 1.0),
                measure=measure.at(0.98, measure.along("root", (1.0, 0.0, 0.0))),
                strict=True,
            ),
        ),
        scenery=(obstacles.bar((0.56, 0.0), 2.3, grip=_GRIP),),
    ),
    config=for_family(),
)
