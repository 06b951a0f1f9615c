# SPDX-License-Identifier: Apache-2.0
"""Jumping up to a bar and swinging to the other side of a block: the reference of `swing_family`.

The hands hold the bar from 0.9 to 1.47 s, if they are at it.
"""

from jaxskills.env import obstacles
from jaxskills.env.holds import Grip
from jaxskills.env.task import TaskSpec
from jaxskills.recipes import Recipe

_GRIP = Grip(("left_wrist", "right_wrist"), begin=0.335, end=0.565)

RECIPE = Recipe(
    name="swing",
    clip="swing",
    note="Our own clip; the bar is 2.3 m high, the block under it 0.3 m.",
    task=TaskSpec(
        scenery=(
            obstacles.bar((0.56, 0.0), 2.3, grip=_GRIP),
            obstacles.box((0.75, 0.0), (0.5, 1.2), 0.3, "block"),
        )
    ),
)
