# SPDX-License-Identifier: Apache-2.0
"""A human jump on Atlas by bounds alone, with the settings of `atlas_walk`."""

from jaxskills.recipes import Recipe, find

RECIPE = Recipe(
    name="atlas_jump",
    clip="jump",
    character="atlas",
    note="DeepMimic jump on a robot of 182 kg, hinges only, neither scaled nor slowed.",
    config=find("atlas_walk").config,
)
