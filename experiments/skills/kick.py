# SPDX-License-Identifier: Apache-2.0
"""DeepMimic kick: the default settings. It does not loop."""

from jaxskills.recipes import Recipe

RECIPE = Recipe(
    name="kick",
    clip="kick",
    note="DeepMimic kick, 1.53 s.",
)
