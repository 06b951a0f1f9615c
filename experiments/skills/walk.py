# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, walk: the default settings."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="walk",
    clip="walk",
    note="DeepMimic walk, 1.27 s a cycle. SB Table 1.",
)
