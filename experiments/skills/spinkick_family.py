# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, SpinKick: how high the foot goes and how far one turns.

The ranges are those of the paper in m and rad. In multiples, as its table has them, they would ask
this clip, whose kick is 0.3 m higher than the paper's, for feet 2.7 m high.
"""

from jaxskills.env import measure
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

RECIPE = Recipe(
    name="spinkick_family",
    clip="spinkick",
    note="A turn of 5.5 rad, the foot 1.8 m high in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "height",
                (0.75, 2.25),
                measure=measure.largest(measure.height("right_ankle"), 0.5, 0.85),
                relative=False,
                sigma=0.15,
            ),
            Parameter(
                "rotation",
                (3.0, 12.0),
                measure=measure.total(measure.turning("root"), 0.0, 1.0),
                relative=False,
                sigma=0.6,
            ),
        )
    ),
    config=for_family(),
)
