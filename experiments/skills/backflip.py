# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, backflip: heading along the lateral axis, which a flip does not turn over."""

from jaxskills.env.core import EnvConfig
from jaxskills.motion import MotionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="backflip",
    clip="backflip",
    note="DeepMimic backflip, 1.75 s a cycle. SB Table 1.",
    # In the clip's flight angular momentum goes from 25 to 65 and back to 22 kg m^2/s: who begins
    # there with it lands on the head or the back.
    config=TrainConfig(env=EnvConfig(heading="lateral"), motion=MotionConfig(ballistic=True)),
)
