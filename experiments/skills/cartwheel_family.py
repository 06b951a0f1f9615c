# SPDX-License-Identifier: Apache-2.0
"""FS Table 1, Cartwheel: how long and how thick arms and legs are."""

from jaxskills.env import conditions, measure
from jaxskills.env.core import EnvConfig
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig, for_family

_ARMS = "right_shoulder", "right_elbow", "left_shoulder", "left_elbow"
_LEGS = "right_hip", "right_knee", "left_hip", "left_knee"
_TOUCH = "right_ankle", "left_ankle", "right_wrist", "left_wrist"

RECIPE = Recipe(
    name="cartwheel_family",
    clip="cartwheel",
    note="On its hands in the clip. FS Table 1.",
    task=TaskSpec(
        (
            Parameter("arm_length", (0.65, 1.65), condition=conditions.length(_ARMS)),
            Parameter("leg_length", (0.65, 1.65), condition=conditions.length(_LEGS)),
            Parameter("arm_width", (1.0, 2.0), condition=conditions.width(_ARMS)),
            Parameter("leg_width", (1.0, 1.6), condition=conditions.width(_LEGS)),
            # A constraint.
            Parameter(
                "rotation",
                (1.0, 1.0),
                measure=measure.total(measure.turning("root", "x"), 0.1, 0.9),
                sigma=0.2,
            ),
        )
    ),
    config=for_family(TrainConfig(env=EnvConfig(may_touch=_TOUCH))),
)
