# SPDX-License-Identifier: Apache-2.0
"""DeepMimic punch: the default settings. It does not loop."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="punch",
    clip="punch",
    note="DeepMimic punch, 2.13 s.",
)
