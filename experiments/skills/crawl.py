# SPDX-License-Identifier: Apache-2.0
"""DeepMimic crawl: arms and legs may touch the ground, heading along the lateral axis."""

from jaxskills.env.core import EnvConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

_LIMBS = ("*_shoulder", "*_elbow", "*_wrist", "*_hip", "*_knee", "*_ankle")

RECIPE = Recipe(
    name="crawl",
    clip="crawl",
    note="DeepMimic crawl, 2.93 s a cycle.",
    config=TrainConfig(env=EnvConfig(may_touch=_LIMBS, heading="lateral")),
)
