# SPDX-License-Identifier: Apache-2.0
"""The policy's feedback controller and the value function, two separate networks (SB fig. 4)."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxskills.errors import UserError

Params = Any


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes and exploration noise."""

    policy: tuple[int, ...] = (512, 256)  # hidden units; SB 4.2: 1024, 512
    value: tuple[int, ...] = (512, 256)
    noise: float = 0.05  # rad, fixed standard deviation of the action; the authors: 0.1


class MLP(nn.Module):
    """A multilayer perceptron with ReLU; `final_scale` 0.01 starts it near zero."""

    hidden: tuple[int, ...]
    out: int
    final_scale: float = 1.0

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Returns `[..., out]` of `x [..., in]`."""
        for width in self.hidden:
            x = nn.relu(nn.Dense(width, kernel_init=nn.initializers.orthogonal(jnp.sqrt(2.0)))(x))
        return nn.Dense(self.out, kernel_init=nn.initializers.orthogonal(self.final_scale))(x)


class Networks(NamedTuple):
    """Pure functions of both networks. Observations are already normalised."""

    init: Callable[[jax.Array], tuple[Params, Params]]  # (key) -> policy, value parameters
    mean: Callable[[Params, jax.Array], jax.Array]  # (params, obs [..., O]) -> action [..., A]
    value: Callable[[Params, jax.Array], jax.Array]  # (params, obs [..., O]) -> [...]
    noise: float
    value_scale: float  # the unit of the value network, the largest return


def make(config: NetworkConfig, obs_size: int, action_size: int, discount: float) -> Networks:
    """Returns the networks. Values are learnt in units of the largest return, 1 / (1 - discount).

    Raises:
      UserError: a layer without units or a noise that is not positive.
    """
    for name, hidden in (("policy", config.policy), ("value", config.value)):
        if not hidden or min(hidden) < 1:
            raise UserError(f"networks.{name} is {hidden}: give positive layer sizes, like 512 256")
    if not 0 < config.noise <= 10:
        raise UserError(
            f"networks.noise is {config.noise}: give a standard deviation in (0, 10] rad"
        )
    policy, value = MLP(config.policy, action_size, 0.01), MLP(config.value, 1, 0.01)
    largest = 1.0 / (1.0 - discount)

    def init(key: jax.Array) -> tuple[Params, Params]:
        policy_key, value_key = jax.random.split(key)
        obs = jnp.zeros((1, obs_size))
        return policy.init(policy_key, obs), value.init(value_key, obs)

    return Networks(
        init=init,
        mean=lambda params, obs: policy.apply(params, obs),  # pyright: ignore
        value=lambda params, obs: largest * value.apply(params, obs)[..., 0],  # pyright: ignore
        noise=config.noise,
        value_scale=largest,
    )


def log_prob(action: jax.Array, mean: jax.Array, noise: float) -> jax.Array:
    """Returns the log density `[...]` of Gaussian actions `[..., A]`, up to a constant."""
    return -0.5 * jnp.sum(((action - mean) / noise) ** 2, axis=-1)
