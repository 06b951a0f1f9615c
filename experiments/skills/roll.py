# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, roll: every body may touch the ground, heading along the lateral axis."""

from jaxskills.env.core import EnvConfig
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="roll",
    clip="roll",
    note="DeepMimic roll, 2.02 s a cycle. SB Table 1.",
    # The clip throws the body back by 0.1 m and forth again within 0.13 s as it begins. Whoever
    # started there with that speed fell: calmer velocities than usual leave it out.
    config=TrainConfig(
        env=EnvConfig(may_touch=("*",), heading="lateral"),
        motion=MotionConfig(smooth_velocity=0.06),
    ),
)
