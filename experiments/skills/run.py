# SPDX-License-Identifier: Apache-2.0
"""SB Table 1, run: the default settings, only the clip differs from walk."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="run",
    clip="run",
    note="DeepMimic run, 0.80 s a cycle. SB Table 1.",
)
