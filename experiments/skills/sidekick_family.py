# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, SideKick: where to, how hard and how high."""

from jaxskills.env import measure, strike
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import for_family

FOOT = strike.Target("right_ankle", share=0.42)
# Where the clip begins, and the way its kick goes from there (rad from forward to the left).
_START, _AHEAD = (0.0, 0.0), -0.17

RECIPE = Recipe(
    name="sidekick_family",
    clip="kick",
    note="0.8 m high at 7.5 m/s in the clip, DeepMimic kick. FS Table 1.",
    task=TaskSpec(
        (
            Parameter(
                "angle",
                (0.0, 0.8),
                measure=measure.at(FOOT.share, measure.bearing(FOOT.body, _START, _AHEAD)),
                relative=False,
            ),
            Parameter("force", (1.0, 6.0), measure=strike.impact(FOOT)),
            Parameter(
                "height", (0.9, 1.1), measure=measure.at(FOOT.share, measure.height(FOOT.body))
            ),
        ),
        objects=(strike.target(FOOT),),
    ),
    config=for_family(),
)
