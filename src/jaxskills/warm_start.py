# SPDX-License-Identifier: Apache-2.0
"""What a training can take over from another run: for a style of a skill, say, or another clip."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxskills import runs
from jaxskills.errors import UserError
from jaxskills.learn.normalize import Normalizer
from jaxskills.trainer import Trainer, TrainState


class Taught(NamedTuple):
    """What a run has learnt."""

    policy: Any  # parameters
    value: Any  # parameters
    normalizer: Normalizer


def read(made: Trainer, run: str | Path) -> Taught:
    """Returns what a run has learnt, for a training that is to begin with it.

    Raises:
      UserError: no such run, or its networks are not like those of the training.
    """
    other = runs.open_run(run)[1]
    found = Taught(other.learner.policy, other.learner.value, other.normalizer)
    learner = jax.eval_shape(made.init, jax.random.key(0)).learner
    wanted, there = (
        {jax.tree_util.keystr(path): x.shape for path, x in jax.tree.leaves_with_path(tree)}
        for tree in ((learner.policy, learner.value), found[:2])
    )
    for name in sorted(wanted.keys() | there.keys()):
        if wanted.get(name) != there.get(name):
            raise UserError(
                f"init_from: in run '{run}' {name} has shape {there.get(name)}, here"
                f" {wanted.get(name)}: give a run with the same character, kind of observation and"
                " networks"
            )
    return found


def begin(state: TrainState, taught: Taught) -> TrainState:
    """Returns a first state with what was learnt elsewhere; all the rest begins anew."""
    learner = dataclasses.replace(state.learner, policy=taught.policy, value=taught.value)
    return dataclasses.replace(state, learner=learner, normalizer=taught.normalizer)
