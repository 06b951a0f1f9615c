# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Dodge: the side to which one ducks."""

from jaxskills.env import measure
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

# Where the neck is before, and the way it goes from there (rad from forward to the left).
_GUARD, _LEFT = (0.04, -0.01), 1.2

RECIPE = Recipe(
    name="dodge_family",
    clip="dodge",
    note="Ducking to the front left in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "angle",
                (-1.5, 1.5),
                measure=measure.at(0.32, measure.bearing("neck", _GUARD, _LEFT)),
                relative=False,
            ),
        )
    ),
    config=for_family(),
)
