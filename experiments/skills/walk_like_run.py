# SPDX-License-Identifier: Apache-2.0
"""SB section 5.3.2 with clips that anyone can install: a walk in the style of a run.

The bounds are those of the authors' style transfer, but hold the centre of mass, for the style does
not ask how fast. Starts evolve, as theirs do. Training goes on after the skill stands.
"""

from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig
from jaxskills.env.style import StyleConfig
from jaxskills.explore.evolution import EvolutionConfig
from jaxskills.recipes import Recipe
from jaxskills.trainer import TrainConfig

_OFF = 4.0  # rad or m, more than there is
_BOUNDED = ("chest", "neck", "right_ankle", "left_ankle")

RECIPE = Recipe(
    name="walk_like_run",
    clip="walk",
    note="DeepMimic walk with the style of the DeepMimic run by Gram matrices. SB section 5.3.2.",
    config=TrainConfig(
        samples=6_000_000,
        stop_when_learnt=False,
        env=EnvConfig(reward="style", style=StyleConfig(style="gram", style_clip="run")),
        bounds=BoundsConfig(joints=_OFF, end_effectors=_OFF, channels=dict.fromkeys(_BOUNDED, 1.0)),
        evolution=EvolutionConfig(enabled=True),
    ),
)
