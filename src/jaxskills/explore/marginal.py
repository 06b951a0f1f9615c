# SPDX-License-Identifier: Apache-2.0
"""The marginal value: what a task parameter is worth under the present policy (FS 6.1).

The value function knows the whole state (a, b): task parameters a, and the rest b. FS eq. 16
integrates b away, at uniform density. Here a network of a alone regresses the values of visited
states; least squares give the mean over the states that it is shown at each a, so the density of b
is the one that they come with. Every state counts alike, wherever it lies: none counts more because
the policy likes to be there. What remains uneven is that an episode that goes well passes through
more states than one that fails early, and would speak louder at the same a: weights of 1 / (states
of its episode) make every episode count alike. How a is spread does not move the mean, only how
well it is known.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxskills.errors import UserError
from jaxskills.learn.networks import MLP, Params

_FLOOR = 1e-3  # least standard deviation, in the values' own unit


@dataclasses.dataclass(frozen=True)
class MarginalConfig:
    """Size and training of the network; FS section 7 but for `steps` and `memory`."""

    hidden: tuple[int, ...] = (512, 512)
    lr: float = 1e-3  # Adam
    minibatch: int = 128
    steps: int = 50  # minibatches in an update
    memory: float = 0.9  # of the running mean and deviation of the values, with each update


@struct.dataclass
class Marginal:
    """The network, its optimiser, and what values are measured by."""

    params: Params
    opt: optax.OptState
    mean: jax.Array  # []
    var: jax.Array  # []
    updates: jax.Array  # [] int32
    hidden: tuple[int, ...] = struct.field(pytree_node=False)


def init(config: MarginalConfig, size: int, key: jax.Array) -> Marginal:
    """Returns a network of `size` task parameters that is near 0 everywhere. The key is consumed.

    Raises:
      UserError: a value out of range.
    """
    validate(config)
    params = _network(config.hidden).init(key, jnp.zeros((1, size)))
    opt = optax.adam(config.lr).init(params)
    return Marginal(params, opt, jnp.zeros(()), jnp.ones(()), jnp.int32(0), config.hidden)


def apply(marginal: Marginal, a: jax.Array) -> jax.Array:
    """Returns the marginal value `[...]` of task parameters `a [..., P]`, in the values' unit."""
    return marginal.mean + _deviation(marginal) * _output(marginal.hidden, marginal.params, a)


def update(
    config: MarginalConfig,
    marginal: Marginal,
    a: jax.Array,
    value: jax.Array,
    key: jax.Array,
    weight: jax.Array | None = None,
) -> tuple[Marginal, jax.Array]:
    """Returns the network after `steps` minibatches, and their mean loss `[]` (FS eq. 16).

    Args:
      config: how; the sizes are those of `init`.
      marginal: before.
      a: `[N, P]` task parameters, normalised to 0 to 1.
      value: `[N]` of visited states; those that are not finite are left out.
      key: of the minibatches, consumed.
      weight: `[N]` how much a state counts, 0 or more; None: all alike.
    """
    weight = jnp.ones(value.shape) if weight is None else weight
    sound = jnp.isfinite(value) & jnp.isfinite(a).all(-1)
    weight = jnp.where(sound, weight, 0.0)
    a, value = jnp.where(sound[:, None], a, 0.0), jnp.where(sound, value, 0.0)
    total = jnp.sum(weight)
    marginal = _measured(config, marginal, value, weight / jnp.maximum(total, 1e-20))
    wanted = (value - marginal.mean) / _deviation(marginal)
    weight = weight * weight.shape[0] / jnp.maximum(total, 1e-20)

    def loss(params: Params, rows: jax.Array) -> jax.Array:
        wrong = _output(marginal.hidden, params, a[rows]) - wanted[rows]
        return jnp.mean(weight[rows] * wrong**2)

    def step(carry: tuple[Any, Any], rows: jax.Array) -> tuple[tuple[Any, Any], jax.Array]:
        params, opt = carry
        found, slope = jax.value_and_grad(loss)(params, rows)
        change, opt = optax.adam(config.lr).update(slope, opt)
        return (optax.apply_updates(params, change), opt), found

    rows = jax.random.randint(key, (config.steps, config.minibatch), 0, value.shape[0])
    (params, opt), losses = jax.lax.scan(step, (marginal.params, marginal.opt), rows)
    done = marginal.replace(params=params, opt=opt, updates=marginal.updates + 1)  # pyright: ignore
    return done, jnp.mean(losses)


def _measured(
    config: MarginalConfig, marginal: Marginal, value: jax.Array, share: jax.Array
) -> Marginal:
    """Returns the marginal with mean and variance of `value [N]` taken in; shares add up to 1.

    Old values fade, since the policy gets better; the first few count alike.
    """
    mean = share @ value
    var = share @ (value - mean) ** 2
    new = jnp.maximum(1.0 - config.memory, 1.0 / (marginal.updates + 1.0))
    new = jnp.where(share.any(), new, 0.0)
    delta = mean - marginal.mean
    var = (1.0 - new) * marginal.var + new * var + new * (1.0 - new) * delta**2
    return marginal.replace(mean=marginal.mean + new * delta, var=var)  # pyright: ignore


def _deviation(marginal: Marginal) -> jax.Array:
    return jnp.maximum(jnp.sqrt(marginal.var), _FLOOR)


def _network(hidden: tuple[int, ...]) -> Any:
    return MLP(hidden, 1, 0.01)


def _output(hidden: tuple[int, ...], params: Params, a: jax.Array) -> jax.Array:
    return _network(hidden).apply(params, 2.0 * a - 1.0)[..., 0]


def validate(config: MarginalConfig) -> None:
    """Checks a configuration.

    Raises:
      UserError: a value out of range.
    """
    if not config.hidden or min(config.hidden) < 1:
        raise UserError(
            f"marginal.hidden is {config.hidden}: give positive layer sizes, like 512 512"
        )
    if not config.lr > 0:
        raise UserError(f"marginal.lr is {config.lr}: give a positive number")
    for name in ("minibatch", "steps"):
        if getattr(config, name) < 1:
            raise UserError(f"marginal.{name} is {getattr(config, name)}: give 1 or more")
    if not 0 <= config.memory < 1:
        raise UserError(f"marginal.memory is {config.memory}: give 0 <= memory < 1")
