# SPDX-License-Identifier: Apache-2.0
"""FS Table 2 and fig. 8, Jump: gravity alone, the energy at take-off stays the reference's."""

import dataclasses

from jaxskills import recipes
from jaxskills.env.task import TaskSpec

_JUMP = recipes.find("jump_family")


def _fixed(task: TaskSpec | None) -> TaskSpec:
    """Returns the task with its energy as a constraint."""
    assert task is not None
    parameters = (
        dataclasses.replace(p, range=(1.0, 1.0)) if p.name == "energy" else p
        for p in task.parameters
    )
    return dataclasses.replace(task, parameters=tuple(parameters))


RECIPE = dataclasses.replace(
    _JUMP,
    name="jump_gravity_family",
    note="As jump_family, with the energy fixed: FS compares methods with it.",
    task=_fixed(_JUMP.task),
)
