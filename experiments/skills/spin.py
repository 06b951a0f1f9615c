# SPDX-License-Identifier: Apache-2.0
"""DeepMimic spin: the default settings."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="spin",
    clip="spin",
    note="DeepMimic spin, 4.42 s a cycle.",
)
