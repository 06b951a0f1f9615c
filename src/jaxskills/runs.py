# SPDX-License-Identifier: Apache-2.0
"""Run folders, opened: what was trained, ready for use."""

import dataclasses
from pathlib import Path
from typing import Any

from jaxskills import checkpoint, families, trainer
from jaxskills.trainer import Trainer, TrainState


def open_run(run: str | Path, backend: str = "auto") -> tuple[Trainer, TrainState]:
    """Returns a trained run, on a backend of this machine instead of the one it learnt on.

    Physics steps are as fine as those that it learnt with last.

    Raises:
      UserError: no such run, or its checkpoint is missing, damaged or of other settings.
    """
    config: Any = dataclasses.replace(checkpoint.read_config(Path(run)), backend=backend)
    made = families.make(config)
    state = checkpoint.restore(Path(run), made)
    return trainer.as_fine(made, state), state
