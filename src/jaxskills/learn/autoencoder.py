# SPDX-License-Identifier: Apache-2.0
"""A convolutional autoencoder of motion, whose hidden features describe style (SB section 3.3).

One layer of filters over time and its inverse, as in Holden et al. 2016, whose network SB uses. It
learns from a minute of motion instead of hours, so it has fewer and shorter filters; and it does
not pool over time, so that features do not depend on where a window begins. Inputs are dropped at
random in training: who is to fill them in must know how bodies move together. All velocities are
dropped at once from half of the windows, so that features make sense without them.
"""

import dataclasses
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxskills import paths
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.errors import UserError

_ARRAYS = ("encoder/kernel", "encoder/bias", "decoder/kernel", "decoder/bias")
_LEAST_SCALE = 1e-3  # of inputs, in their own unit


@dataclasses.dataclass(frozen=True)
class AutoencoderConfig:
    """Sizes and training."""

    channels: int = 64  # C; Holden et al.: 256
    width: int = 13  # K, frames of a filter, 0.43 s; Holden et al.: 25 at 60 Hz
    window: int = 48  # T, frames of what is learnt from
    speeds: tuple[float, ...] = (0.8, 1.0, 1.25)  # at which each motion is seen
    dropout: float = 0.2  # share of the inputs that are dropped
    sparsity: float = 1e-5  # weight of the filters' absolute sum in the loss
    steps: int = 2000
    batch: int = 32
    lr: float = 1e-3  # Adam, down to 0 along a cosine


@struct.dataclass
class Autoencoder:
    """A network, and what its inputs are measured by."""

    params: Any
    mean: jax.Array  # [D]
    scale: jax.Array  # [D] one for all positions, one for the velocity, one for the turning
    bodies: tuple[str, ...] = struct.field(pytree_node=False)  # N names, D = 3 N + 4

    @property
    def width(self) -> int:
        """K, how many frames make one row of hidden features."""
        return self.params["encoder"]["kernel"].shape[0] // self.mean.shape[0]


class _Network(nn.Module):
    """Convolutions as products of stacked frames: `nn.Conv` takes 7 times as long on a CPU."""

    channels: int
    width: int
    size: int

    def setup(self) -> None:
        self.encoder = nn.Dense(self.channels)
        self.decoder = nn.Dense(self.size)

    def encode(self, x: jax.Array) -> jax.Array:
        return nn.relu(self.encoder(_stacked(x, self.width)))

    def decode(self, hidden: jax.Array) -> jax.Array:
        around = [(0, 0)] * (hidden.ndim - 2) + [(self.width - 1,) * 2, (0, 0)]
        return self.decoder(_stacked(jnp.pad(hidden, around), self.width))

    def __call__(self, x: jax.Array) -> jax.Array:
        return self.decode(self.encode(x))


def _stacked(x: jax.Array, width: int) -> jax.Array:
    """Returns each `width` rows of `x [..., T, X]` as one: `[..., T - width + 1, width X]`."""
    count = x.shape[-2] - width + 1
    return jnp.concatenate([x[..., i : i + count, :] for i in range(width)], axis=-1)


def encode(model: Autoencoder, frames: jax.Array) -> jax.Array:
    """Returns the hidden features `[..., T - K + 1, C]` of `frames [..., T, D]`, none negative.

    A row depends on K frames, the last row on the last K.
    """
    return _apply(model, "encode", (frames - model.mean) / model.scale)


def style(model: Autoencoder, frames: jax.Array) -> jax.Array:
    """Returns the hidden features `[..., T - K + 1, C]` that style is told by: of postures alone.

    A run and a walk of one style differ in speed above all, and speed would drown the rest.
    """
    return encode(model, without_velocities(model, frames))


def without_velocities(model: Autoencoder, frames: jax.Array) -> jax.Array:
    """Returns `frames [..., D]` with the root's velocities at their mean."""
    return jnp.concatenate(
        (frames[..., :-4], jnp.broadcast_to(model.mean[-4:], (*frames.shape[:-1], 4))), axis=-1
    )


def decode(model: Autoencoder, hidden: jax.Array) -> jax.Array:
    """Returns frames `[..., T, D]` for hidden features `[..., T - K + 1, C]`.

    Few filters reach the first and last K - 1, so these are not what was encoded.
    """
    return _apply(model, "decode", hidden) * model.scale + model.mean


def _apply(model: Autoencoder, method: str, x: jax.Array) -> jax.Array:
    channels = model.params["encoder"]["bias"].shape[0]
    network: Any = _Network(channels, model.width, model.mean.shape[0])
    return network.apply({"params": model.params}, x, method=method)


def init(
    config: AutoencoderConfig, bodies: Sequence[str], data: jax.Array, key: jax.Array
) -> Autoencoder:
    """Returns an untrained autoencoder. The key is consumed.

    Args:
      config: its sizes.
      bodies: names of the N bodies that the features are of.
      data: `[M, T, D]` windows (`windows.cut`), which give mean and scale.
      key: of the weights.

    Raises:
      UserError: a value out of range.
    """
    validate(config)
    size = data.shape[-1]
    mean = jnp.mean(data, axis=(0, 1))
    variance = jnp.mean((data - mean) ** 2, axis=(0, 1))
    groups = (variance[:-4], variance[-4:-1], variance[-1:])
    scale = jnp.concatenate([jnp.full(len(g), jnp.sqrt(jnp.mean(g))) for g in groups])
    network: Any = _Network(config.channels, config.width, size)
    params = network.init(key, jnp.zeros((1, config.window, size)))["params"]
    return Autoencoder(params, mean, jnp.maximum(scale, _LEAST_SCALE), tuple(bodies))


def train(
    config: AutoencoderConfig, model: Autoencoder, data: jax.Array, key: jax.Array
) -> tuple[Autoencoder, jax.Array]:
    """Returns the autoencoder trained on `data [M, T, D]`, and the loss `[steps]` along the way.

    The same key gives the same bits. It is consumed.

    Raises:
      UserError: a value out of range.
    """
    validate(config)
    optimizer = optax.adam(optax.cosine_decay_schedule(config.lr, config.steps))

    def run(model: Autoencoder, data: jax.Array, key: jax.Array) -> tuple[Any, jax.Array]:
        def step(carry: tuple[Any, optax.OptState], key: jax.Array) -> tuple[Any, jax.Array]:
            params, state = carry
            row_key, drop_key = jax.random.split(key)
            batch = data[jax.random.randint(row_key, (config.batch,), 0, data.shape[0])]
            value, slope = jax.value_and_grad(_loss)(params, config, model, batch, drop_key)
            change, state = optimizer.update(slope, state)
            return (optax.apply_updates(params, change), state), value

        begin = model.params, optimizer.init(model.params)
        (params, _), losses = jax.lax.scan(step, begin, jax.random.split(key, config.steps))
        return params, losses

    params, losses = jit(run)(model, data, key)
    return dataclasses.replace(model, params=params), losses


def _loss(
    params: Any, config: AutoencoderConfig, model: Autoencoder, batch: jax.Array, key: jax.Array
) -> jax.Array:
    trial = dataclasses.replace(model, params=params)
    one_key, all_key = jax.random.split(key)
    keep = jax.random.bernoulli(one_key, 1.0 - config.dropout, batch.shape)
    # What is dropped becomes the mean; the rest is scaled up so that sums stay what they were.
    seen = jnp.where(keep, (batch - model.mean) / (1.0 - config.dropout), 0.0) + model.mean
    whole = jax.random.bernoulli(all_key, 0.5, (batch.shape[0], 1, 1))
    seen = jnp.where(whole, seen, without_velocities(model, seen))
    filters = sum(jnp.sum(jnp.abs(layer["kernel"])) for layer in params.values())
    wrong = _inner(trial, decode(trial, encode(trial, seen)) - batch) / model.scale
    return jnp.mean(wrong**2) + config.sparsity * filters


def error(model: Autoencoder, data: jax.Array) -> jax.Array:
    """Returns the root mean square error `[D]` of reconstructing `data [M, T, D]`, in its units."""
    wrong = _inner(model, decode(model, encode(model, data)) - data)
    return jnp.sqrt(jnp.mean(wrong**2, axis=(0, 1)))


def _inner(model: Autoencoder, frames: jax.Array) -> jax.Array:
    """Returns those of `frames [M, T, D]` that all filters reach."""
    return frames[:, model.width - 1 : frames.shape[1] - model.width + 1]


def validate(config: AutoencoderConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    for name in ("channels", "width", "steps", "batch"):
        if getattr(config, name) < 1:
            raise UserError(f"autoencoder.{name} is {getattr(config, name)}: give 1 or more")
    least = 2 * config.width - 1
    if config.window < least:
        raise UserError(f"autoencoder.window is {config.window}: give {least} frames or more")
    if not config.speeds or not min(config.speeds) > 0:
        raise UserError(f"autoencoder.speeds is {config.speeds}: give positive numbers")
    if not 0 <= config.dropout < 1:
        raise UserError(f"autoencoder.dropout is {config.dropout}: give 0 <= dropout < 1")
    if not config.sparsity >= 0:
        raise UserError(f"autoencoder.sparsity is {config.sparsity}: give 0 or more")
    if not config.lr > 0:
        raise UserError(f"autoencoder.lr is {config.lr}: give a positive number")


def shipped() -> Path:
    """Returns the file of the autoencoder for `humanoid34` that comes with the package."""
    return paths.data_dir() / "autoencoder.npz"


def save(model: Autoencoder, path: str | Path) -> Path:
    """Writes the autoencoder as npz, nothing lost, and returns the path written.

    Raises:
      UserError: another suffix.
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise UserError(f"autoencoders are saved as .npz, not '{path}'")
    arrays = {"bodies": np.array(model.bodies), "mean": model.mean, "scale": model.scale}
    for name in _ARRAYS:
        layer, part = name.split("/")
        arrays[name] = model.params[layer][part]
    np.savez_compressed(path, **arrays)
    return path


def load(path: str | Path, character: Character) -> Autoencoder:
    """Returns the autoencoder of a file, for a character with the bodies that it learnt from.

    Raises:
      UserError: no such file, a damaged one, or one for other bodies.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("bodies", "mean", "scale", *_ARRAYS)}
    except FileNotFoundError:
        raise UserError(f"autoencoder '{path}' does not exist: give an npz file") from None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as problem:
        reason = " ".join(str(problem).split())
        raise UserError(f"autoencoder '{path}' is not a sound npz file: {reason}") from None
    bodies = tuple(map(str, arrays["bodies"]))
    if bodies != character.body_names:
        raise UserError(
            f"autoencoder '{path}' knows the bodies {', '.join(bodies)}, character"
            f" '{character.name}' has others: train one with experiments/autoencoder.py"
        )
    params: dict[str, dict[str, jax.Array]] = {"encoder": {}, "decoder": {}}
    for name in _ARRAYS:
        layer, part = name.split("/")
        params[layer][part] = jnp.asarray(arrays[name])
    return Autoencoder(params, jnp.asarray(arrays["mean"]), jnp.asarray(arrays["scale"]), bodies)
