# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, run jump: the clip is the user's own, named humanoid3d_run_jump.txt."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="run_jump",
    clip="run_jump",
    note="From a folder named by JAXSKILLS_CLIP_DIR. SB Table 1.",
)
