# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, backflip: heading along the lateral axis, which a flip does not turn over."""

from jaxskills.env.core import EnvConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="backflip",
    clip="backflip",
    note="DeepMimic backflip, 1.75 s a cycle. SB Table 1.",
    config=TrainConfig(env=EnvConfig(heading="lateral")),
)
