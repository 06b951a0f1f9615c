# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a run: the whole `TrainState`, written beside the last one and then swapped in.

A run folder holds `config.json`, `metrics.jsonl`, TensorBoard events and `checkpoints/SAMPLES/`.
"""

import dataclasses
import errno
import json
import os
import shutil
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from jaxskills import paths
from jaxskills.errors import UserError
from jaxskills.trainer import TrainConfig, Trainer, TrainState

_KEPT = 2  # checkpoints; a damaged newest one does not cost the run


def save(run: Path, state: TrainState, samples: int) -> Path:
    """Writes `RUN/checkpoints/SAMPLES` and removes older ones.

    It is complete or absent: a full disk or a kill leaves what was saved before.

    Raises:
      OSError: the disk is full or the folder cannot be written.
    """
    folder = (run / "checkpoints").absolute()
    path = folder / f"{samples:012d}"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _need(folder, sum(leaf.nbytes for leaf in jax.tree.leaves(state)))
        with ocp.StandardCheckpointer() as writer:
            writer.save(path, state)
    for old in existing(run)[:-_KEPT]:
        shutil.rmtree(folder / f"{old:012d}", ignore_errors=True)
    return path


def _need(folder: Path, size: int) -> None:
    """Raises OSError without room for `size` bytes: orbax would leave half a checkpoint."""
    if shutil.disk_usage(folder).free < 1.1 * size + 65536:  # its own files come on top
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def existing(run: Path) -> list[int]:
    """Returns the sample counts of the run's checkpoints, ascending."""
    return sorted(
        int(path.name) for path in (run / "checkpoints").glob("[0-9]" * 12) if path.is_dir()
    )


def restore(run: Path, trainer: Trainer) -> TrainState:
    """Returns the newest state of a run.

    Raises:
      UserError: there is none, or it is damaged or of another configuration.
    """
    found = existing(run)
    if not found:
        raise UserError(f"run '{run}' holds no checkpoint yet: train it for longer")
    path = (run / "checkpoints" / f"{found[-1]:012d}").absolute()
    shapes = jax.eval_shape(trainer.init, jax.random.key(0))
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    target = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=here), shapes)
    try:
        return _read(path, target)
    except Exception as error:  # orbax raises many kinds for missing, cut off or reshaped arrays
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        remedy = (
            f"remove it to fall back on {found[-2]} samples" if len(found) > 1 else "train anew"
        )
        raise UserError(
            f"checkpoint '{path}' is damaged or of other settings ({reason}): {remedy}"
        ) from None


def _read(path: Path, target: TrainState) -> TrainState:
    """Returns the state saved at `path`, in the shapes of `target`.

    Optional parts that neither has (None) need not be mentioned there: they may be younger.

    Raises:
      Exception: of many kinds, for missing, cut off or reshaped arrays.
    """
    with ocp.StandardCheckpointer() as reader:
        tree = reader.metadata(path).item_metadata.tree  # pyright: ignore
    saved = {leaf.name: leaf.shape for leaf in jax.tree.leaves(tree)}
    named = {".".join(names): leaf for names, leaf in ocp.tree.to_flat_dict(target).items()}
    asked = {name: leaf for name, leaf in named.items() if leaf is not None}
    for name in sorted(saved.keys() ^ asked.keys()):
        raise ValueError(f"{name} is {'not wanted' if name in saved else 'missing'}")
    for name, leaf in asked.items():
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        if leaf.shape != saved[name] and not is_key:
            raise ValueError(f"{name} has shape {saved[name]} instead of {leaf.shape}")
    how = ocp.args.PyTreeRestore(
        target,
        restore_args=ocp.checkpoint_utils.construct_restore_args(target),
        partial_restore=True,
    )
    with ocp.PyTreeCheckpointer() as reader:
        return reader.restore(path, args=how)


def write_config(run: Path, config: TrainConfig) -> None:
    """Writes `RUN/config.json`."""
    text = json.dumps(dataclasses.asdict(config), indent=2)
    paths.write_whole(run / "config.json", text + "\n")


def read_config(run: Path) -> TrainConfig:
    """Returns the configuration of a run.

    Raises:
      UserError: no such run, or its config.json is damaged or of another version.
    """
    path = run / "config.json"
    if not path.is_file():
        raise UserError(f"'{run}' is not a run: it has no config.json")
    try:
        return _build(TrainConfig, json.loads(path.read_text()))
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"'{path}' is damaged: {' '.join(str(error).split())}") from None


def _build(kind: Any, value: Any) -> Any:
    """Returns JSON data as the annotated type: dataclasses, tuples, mappings, unions, plain."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise ValueError(f"{kind.__name__} is not an object")
        hints = typing.get_type_hints(kind)
        unknown = set(value) - set(hints)
        if unknown:
            raise ValueError(f"unknown entry {', '.join(sorted(unknown))}")
        return kind(**{name: _build(hints[name], item) for name, item in value.items()})
    if origin in (typing.Union, types.UnionType):
        plain = [option for option in arguments if typing.get_origin(option) is not tuple]
        return _frozen(value) if isinstance(value, list) else (value if plain else None)
    if origin is tuple:
        return tuple(value)
    if origin is Mapping:
        return {name: _build(arguments[1], item) for name, item in value.items()}
    return value


def _frozen(value: Any) -> Any:
    """Returns lists, and lists in lists, as tuples."""
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value
