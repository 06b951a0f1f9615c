# SPDX-License-Identifier: Apache-2.0
"""Room for the style of another clip in a run (SB 5.3.2): CoM, root, chest, neck and ankles alone.

jaxskills train run_style --env.reward style --env.style.style gram --env.style.style-clip walk

As in the authors' style transfer, but the centre of mass is bound along the ground too, for the
style does not ask how fast. Starts evolve, as theirs do.
"""

from jaxskills.env.bounds import BoundsConfig
from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

RECIPE = Recipe(
    name="run_style",
    clip="run",
    note="Plain without a style; styles: gram, with the style clip of your choice. SB 5.3.2.",
    config=TrainConfig(
        bounds=BoundsConfig(
            joints=4.0,
            end_effectors=10.0,
            channels={"chest": 1.0, "neck": 1.0, "right_ankle": 1.0, "left_ankle": 1.0},
        ),
        evolution=EvolutionConfig(enabled=True),
    ),
)
