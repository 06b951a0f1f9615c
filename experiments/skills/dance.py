# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, dance: the default settings."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="dance",
    clip="dance_a",
    note="DeepMimic dance a, 1.62 s a cycle. SB Table 1.",
)
