# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Punch: where to and how hard."""

from jaxskills.env import measure, strike
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

FIST = strike.Target("right_wrist", share=0.375)
# Where the clip begins, and the way its punch goes from there (rad from forward to the left).
_START, _AHEAD = (0.0, 0.0), 0.56

RECIPE = Recipe(
    name="punch_family",
    clip="punch",
    note="1.5 m ahead and 1.2 m high at 6 m/s in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "angle",
                (0.0, 1.0),
                measure=measure.at(FIST.share, measure.bearing(FIST.body, _START, _AHEAD)),
                relative=False,
            ),
            Parameter(
                "distance",
                (0.8, 1.4),
                measure=measure.at(FIST.share, measure.distance(FIST.body, _START)),
            ),
            Parameter("force", (1.0, 5.5), measure=strike.impact(FIST)),
            Parameter(
                "height", (0.9, 1.1), measure=measure.at(FIST.share, measure.height(FIST.body))
            ),
        ),
        objects=(strike.target(FIST),),
    ),
    config=for_family(),
)
