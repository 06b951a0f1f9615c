# SPDX-License-Identifier: Apache-2.0
"""DeepMimic crawl: arms and legs may touch the ground, heading along the lateral axis."""

from jaxskills.env.core import EnvConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

_BODIES = (
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
    name="crawl",
    clip="crawl",
    note="DeepMimic crawl, 2.93 s a cycle.",
    config=TrainConfig(env=EnvConfig(may_touch=_BODIES, heading="lateral")),
)
