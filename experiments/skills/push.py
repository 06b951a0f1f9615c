# SPDX-License-Identifier: Apache-2.0
"""Pushing a box of 18 kg by 1.2 m, as in FS section 7.1. It does not loop."""

from jaxskills.env import push
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.task import TaskSpec
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

BOX = push.Box(("right_wrist", "left_wrist"), begin=0.15, end=0.81, face=0.65)

RECIPE = Recipe(
    name="push",
    clip="push",
    note="Hands stick to an 18 kg box that slides with friction 0.3.",
    task=TaskSpec(objects=(push.box(BOX),)),
    # The box is where the clip's is, but for the length of a forearm.
    config=TrainConfig(bounds=BoundsConfig(channels={"box": 0.3})),
)
