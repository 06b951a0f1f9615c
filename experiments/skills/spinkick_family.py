# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, SpinKick: how high the foot goes and how far one turns."""

from jaxskills.env import measure
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

RECIPE = Recipe(
    name="spinkick_family",
    clip="spinkick",
    note="A turn of 5.5 rad, the foot 1.8 m high in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "height",
                (0.5, 1.5),
                measure=measure.largest(measure.height("right_ankle"), 0.5, 0.85),
            ),
            Parameter(
                "rotation",
                (0.5, 2.0),
                measure=measure.total(measure.turning("root"), 0.0, 1.0),
            ),
        )
    ),
    # A tenth of the range, where the next elite may be, is 0.8 rad: so far one may turn from a
    # motion to find another. The authors' episodes end at 0.4 pi.
    config=for_family(TrainConfig(bounds=BoundsConfig(root=1.26))),
)
