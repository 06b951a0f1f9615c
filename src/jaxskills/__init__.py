# SPDX-License-Identifier: Apache-2.0
"""Physics-based motor skills from one short motion clip, in JAX."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxskills.character import Character as Character
    from jaxskills.clip.data import Clip as Clip
    from jaxskills.controller import family_controller as family_controller
    from jaxskills.env.bounds import BoundsConfig as BoundsConfig
    from jaxskills.env.core import EnvConfig as EnvConfig
    from jaxskills.env.core import Environment as Environment
    from jaxskills.env.task import Parameter as Parameter
    from jaxskills.env.task import TaskSpec as TaskSpec
    from jaxskills.errors import UserError as UserError
    from jaxskills.evaluate import EvaluateConfig as EvaluateConfig
    from jaxskills.evaluate import Trace as Trace
    from jaxskills.explore.starts import StartsConfig as StartsConfig
    from jaxskills.learn.networks import NetworkConfig as NetworkConfig
    from jaxskills.learn.ppo import PPOConfig as PPOConfig
    from jaxskills.motion import Motion as Motion
    from jaxskills.motion import MotionConfig as MotionConfig
    from jaxskills.recipes import Recipe as Recipe
    from jaxskills.retarget.mapping import Mapping as Mapping
    from jaxskills.runs import open_run as open_run
    from jaxskills.trainer import TrainConfig as TrainConfig
    from jaxskills.trainer import Trainer as Trainer
    from jaxskills.trainer import TrainState as TrainState

__version__ = "0.1.0"

# Public name -> its module. A name is imported on first use, so that `jaxskills --help` and a
# mistyped command need not wait for JAX.
_MODULE = {
    "BoundsConfig": "env.bounds",
    "Character": "character",
    "Clip": "clip.data",
    "EnvConfig": "env.core",
    "Environment": "env.core",
    "EvaluateConfig": "evaluate",
    "Mapping": "retarget.mapping",
    "Motion": "motion",
    "MotionConfig": "motion",
    "NetworkConfig": "learn.networks",
    "PPOConfig": "learn.ppo",
    "Parameter": "env.task",
    "Recipe": "recipes",
    "StartsConfig": "explore.starts",
    "TaskSpec": "env.task",
    "Trace": "evaluate",
    "TrainConfig": "trainer",
    "TrainState": "trainer",
    "Trainer": "trainer",
    "UserError": "errors",
    "family_controller": "controller",
    "open_run": "runs",
}

__all__ = ["__version__", *_MODULE]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module 'jaxskills' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"jaxskills.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
