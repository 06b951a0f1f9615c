# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Pivot: how far one turns."""

from jaxskills.env import measure
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

RECIPE = Recipe(
    name="pivot_family",
    clip="pivot",
    note="77 degrees to the right in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "rotation",
                (0.8, 2.5),
                measure=measure.total(measure.turning("root"), 0.0, 1.0),
            ),
        )
    ),
    config=for_family(),
)
