# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Backflip: how fast one turns in the air, and how high one jumps."""

from jaxskills.env import measure
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

# Off the ground, as shares of the clip.
_AIR = 0.42, 0.66

RECIPE = Recipe(
    name="backflip_family",
    clip="backflip",
    note="A whole turn backwards in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter("spin", (0.5, 2.0), measure=measure.mean(measure.spinning, *_AIR)),
            Parameter("height", (0.8, 1.3), measure=measure.largest(measure.com_height, *_AIR)),
            # Constraints.
            Parameter(
                "angular_momentum",
                (1.0, 1.0),
                measure=measure.mean(measure.angular_momentum("y"), *_AIR),
                sigma=0.2,
            ),
            Parameter(
                "rotation",
                (1.0, 1.0),
                measure=measure.total(measure.turning("root", "y"), 0.2, 0.9),
                sigma=0.2,
            ),
        )
    ),
    # Its turning in flight is not that of a thrown body: see the recipe of the backflip alone. It
    # is done once: after the landing one stands, instead of crouching for the next flip.
    config=for_family(
        TrainConfig(
            env=EnvConfig(heading="lateral"), motion=MotionConfig(ballistic=True, loop=False)
        )
    ),
)
