# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Jump: energy at take-off, and gravity."""

from jaxskills.env import conditions, measure
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

RECIPE = Recipe(
    name="jump_family",
    clip="jump",
    note="0.3 m off the ground in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter("energy", (0.8, 1.8), measure=measure.at(0.44, measure.kinetic_energy)),
            Parameter("gravity", (0.2, 1.65), condition=conditions.gravity),
            # A constraint: the feet are down again, and stay.
            Parameter(
                "foot_contact",
                (1.0, 1.0),
                measure=measure.mean(measure.ground_height, 0.8, 0.95),
                sigma=0.5,
            ),
        )
    ),
    # After the landing one stands, instead of crouching for the next jump.
    config=for_family(TrainConfig(motion=MotionConfig(loop=False))),
)
