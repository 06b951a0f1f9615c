# SPDX-License-Identifier: Apache-2.0
"""The network that maps task parameters to motions (FS 5.2), and when it is trusted (FS 5.3).

It learns from elites alone. Inside, every entry of a motion is measured by its mean and deviation
over the elites: displacements are in rad and m, time is a logarithm, and the loss of FS eq. 12,
which adds their squares as they are, would mostly see whichever is largest.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxskills.errors import UserError
from jaxskills.explore import elites as elites_lib
from jaxskills.explore.elites import Elites
from jaxskills.learn.networks import MLP, Params

_LEAST_SCALE = 1e-3  # of an entry that hardly differs between elites, in its own unit


@dataclasses.dataclass(frozen=True)
class ParameterizationConfig:
    """Size and training of the network, and how it takes over from the proxy."""

    hidden: tuple[int, ...] = (512, 512)  # FS 7
    lr: float = 1e-3  # Adam, FS 7
    minibatch: int = 128  # FS 7
    steps: int = 10  # minibatches of one update; FS 7: an update follows ten of the policy
    memory: float = 0.9  # of the running average of the loss, with each minibatch
    # The network is trusted when the root mean square of an entry's error (rad, m, log of speed)
    # falls below this. FS 5.3 gives no number; noise of the actions is in the elites and stays.
    threshold: float = 0.1
    neighbours: int = 5  # k of FS 5.3, elites that the proxy goes by
    sigma: float = 0.28  # sigma_k of FS 5.3
    ridge: float = 0.03  # of the proxy: closer together elites differ by chance


@struct.dataclass
class Parameterization:
    """The network, what its outputs are measured by, and how well it does."""

    params: Params
    opt: optax.OptState
    mean: jax.Array  # [M] of the elites
    scale: jax.Array  # [M] deviation of the elites
    loss: jax.Array  # [] running average of FS eq. 12, for one motion; inf before any update
    hidden: tuple[int, ...] = struct.field(pytree_node=False)


def init(
    config: ParameterizationConfig, parameters: int, size: int, key: jax.Array
) -> Parameterization:
    """Returns an untrained network from P = `parameters` to M = `size` numbers.

    The key is consumed.
    """
    params = MLP(config.hidden, size, 0.01).init(key, jnp.zeros((1, parameters)))
    opt = optax.adam(config.lr).init(params)
    zeros, ones = jnp.zeros(size), jnp.ones(size)
    return Parameterization(params, opt, zeros, ones, jnp.float32(jnp.inf), config.hidden)


def apply(state: Parameterization, a: jax.Array) -> jax.Array:
    """Returns the network's motions `[..., M]` for task parameters `a [..., P]` (FS eq. 11)."""
    return state.mean + state.scale * _network(state, state.params, a)


def update(
    config: ParameterizationConfig, state: Parameterization, elites: Elites, key: jax.Array
) -> Parameterization:
    """Returns the network after some minibatches of elites (FS eq. 12). The key is consumed.

    Without elites nothing changes.
    """
    count = jnp.sum(elites.used)
    members = jnp.argsort(~elites.used)  # stable: the rows in use come first
    shape = (config.steps, config.minibatch)
    rows = members[jax.random.randint(key, shape, 0, jnp.maximum(count, 1))]
    return jax.lax.cond(
        count > 0, lambda: _train(config, _measured(state, elites), elites, rows), lambda: state
    )


def _measured(state: Parameterization, elites: Elites) -> Parameterization:
    """Returns the state with mean and scale of the present elites."""
    used = elites.used[:, None]
    scale = jnp.maximum(jnp.std(elites.x, axis=0, where=used), _LEAST_SCALE)
    return dataclasses.replace(state, mean=jnp.mean(elites.x, axis=0, where=used), scale=scale)


def _train(
    config: ParameterizationConfig, state: Parameterization, elites: Elites, rows: jax.Array
) -> Parameterization:
    """Returns the state after one step for each of `rows [steps, minibatch]`."""
    optimizer = optax.adam(config.lr)

    def loss_of(params: Params, a: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        wrong = _network(state, params, a) - (x - state.mean) / state.scale
        return jnp.mean(wrong**2), jnp.mean(jnp.sum((state.scale * wrong) ** 2, axis=-1))

    def step(carry: tuple[Any, ...], rows: jax.Array) -> tuple[tuple[Any, ...], None]:
        params, opt, average = carry
        slope, loss = jax.grad(loss_of, has_aux=True)(params, elites.a[rows], elites.x[rows])
        change, opt = optimizer.update(slope, opt)
        blended = config.memory * average + (1.0 - config.memory) * loss
        average = jnp.where(jnp.isfinite(average), blended, loss)
        return (optax.apply_updates(params, change), opt, average), None

    carry, _ = jax.lax.scan(step, (state.params, state.opt, state.loss), rows)
    params, opt, average = carry
    return dataclasses.replace(state, params=params, opt=opt, loss=average)


def _network(state: Parameterization, params: Params, a: jax.Array) -> jax.Array:
    """Returns motions `[..., M]` in deviations from the mean."""
    network: Any = MLP(state.hidden, state.mean.shape[0], 0.01)
    return network.apply(params, 2.0 * a - 1.0)


def trusted(config: ParameterizationConfig, state: Parameterization) -> jax.Array:
    """Returns bool `[]`, the loss is below the threshold (FS 5.3)."""
    return state.loss < config.threshold**2 * state.mean.shape[0]


def draw(
    config: ParameterizationConfig,
    state: Parameterization,
    elites: Elites,
    a: jax.Array,
    key: jax.Array,
) -> jax.Array:
    """Returns motions `[B, M]` to imitate, for task parameters `a [B, P]` (FS 5.3).

    Those of the proxy until the network is trusted, then for each row either with equal chance.
    The key is consumed.
    """
    likely = elites_lib.proxy(elites, a, config.neighbours, config.sigma, config.ridge)
    coin = jax.random.bernoulli(key, 0.5, a.shape[:-1]) & trusted(config, state)
    return jnp.where(coin[..., None], apply(state, a), likely)


def validate(config: ParameterizationConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not config.hidden or min(config.hidden) < 1:
        raise UserError(
            f"parameterization.hidden is {config.hidden}: give positive layer sizes, like 512 512"
        )
    for name in ("minibatch", "steps", "neighbours"):
        if not 1 <= getattr(config, name) <= 1_000_000:
            raise UserError(
                f"parameterization.{name} is {getattr(config, name)}: give 1 to 1000000"
            )
    for name in ("lr", "sigma", "ridge"):
        if not 0 < getattr(config, name) < 1000:
            raise UserError(
                f"parameterization.{name} is {getattr(config, name)}: give a positive number"
            )
    if not 0 <= config.memory < 1:
        raise UserError(f"parameterization.memory is {config.memory}: give 0 <= memory < 1")
    if not config.threshold >= 0:
        raise UserError(
            f"parameterization.threshold is {config.threshold}: give 0 (never the network) or more"
        )
