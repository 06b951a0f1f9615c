# SPDX-License-Identifier: Apache-2.0
"""Room for styles around the cartwheel (SB 5.3.1): CoM, root, neck and ankles alone are bound.

jaxskills train cartwheel_style --env.reward style --env.style.style energy_down --out RUN
"""

from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="cartwheel_style",
    clip="cartwheel",
    note="Plain without a style; styles: energy_up, energy_down, volume_up, volume_down.",
    config=TrainConfig(
        env=EnvConfig(may_touch=("right_ankle", "left_ankle", "right_wrist", "left_wrist")),
        bounds=BoundsConfig(
            joints=4.0,
            end_effectors=10.0,
            channels={"neck": 1.0, "right_ankle": 1.0, "left_ankle": 1.0},
        ),
    ),
)
