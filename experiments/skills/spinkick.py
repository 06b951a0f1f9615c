# SPDX-License-Identifier: Apache-2.0
"""DeepMimic spinkick: the default settings."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="spinkick",
    clip="spinkick",
    note="DeepMimic spinkick, 1.28 s a cycle.",
)
