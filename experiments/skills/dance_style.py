# SPDX-License-Identifier: Apache-2.0
"""Room for styles around the dance (SB 5.3.1): joints 1 rad, end effectors 1 m.

jaxskills train dance_style --env.reward style --env.style.style energy_down --out RUN
"""

from jaxskills.env.bounds import BoundsConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="dance_style",
    clip="dance_a",
    note="Plain without a style; styles: energy_up, energy_down, volume_up, volume_down.",
    config=TrainConfig(bounds=BoundsConfig(joints=1.0, end_effectors=1.0)),
)
