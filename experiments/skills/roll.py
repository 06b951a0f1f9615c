# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, roll: every body may touch the ground, heading along the lateral axis."""

from jaxskills.env.core import EnvConfig
from jaxskills.explore.refine import RefineConfig
from jaxskills.explore.starts import StartsConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

_BODIES = (
    "root",
    "chest",
    "neck",
    "right_shoulder",
    "left_shoulder",
    "right_elbow",
    "left_elbow",
    "right_wrist",
    "left_wrist",
    "right_hip",
    "left_hip",
    "right_knee",
    "left_knee",
    "right_ankle",
    "left_ankle",
)

RECIPE = Recipe(
    name="roll",
    clip="roll",
    note="DeepMimic roll, 2.02 s a cycle. SB Table 1.",
    # Noise shortens a roll: by the time it gets 8 s far with it, the mean action gets 20. The clip
    # throws the body back and forth as it begins: starts there need more than their share.
    config=TrainConfig(
        env=EnvConfig(may_touch=_BODIES, heading="lateral"),
        refine=RefineConfig(survival=8.0),
        starts=StartsConfig(renewal=1.5),
    ),
)
