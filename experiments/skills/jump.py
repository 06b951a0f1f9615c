# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, jump: the default settings."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="jump",
    clip="jump",
    note="DeepMimic jump, 1.77 s a cycle. SB Table 1.",
)
