# SPDX-License-Identifier: Apache-2.0
"""DeepMimic spin: heading along the lateral axis, since the body faces the ground in the air."""

from jaxskills.env.core import EnvConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="spin",
    clip="spin",
    note="DeepMimic spin, 4.42 s a cycle.",
    config=TrainConfig(env=EnvConfig(heading="lateral")),
)
