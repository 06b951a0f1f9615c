# SPDX-License-Identifier: Apache-2.0
"""Generalised advantage estimation with variable time steps (FS eq. 9)."""

import chex
import jax
import jax.numpy as jnp


def discounted(rate: jax.Array, dphase: jax.Array, gamma: float) -> jax.Array:
    """Returns the worth now of a constant reward rate over the coming `dphase`.

    integral of gamma^v rate dv from 0 to dphase = rate (gamma^dphase - 1) / ln gamma.
    """
    return rate * jnp.expm1(dphase * jnp.log(gamma)) / jnp.log(gamma)


def advantages(
    rate: jax.Array,
    spike: jax.Array,
    dphase: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    ended: jax.Array,
    gamma: float,
    lambda_: float,
) -> jax.Array:
    """Returns the advantages `[T]` of one sequence; `vmap` for more.

    delta_t = integral of gamma^v rate_t dv + spike_t + gamma^dphase_t V'_t - V_t
    A_t     = delta_t + (gamma lambda)^dphase_t A_{t+1}

    where V' is 0 after a termination, and A_{t+1} is 0 where the episode ended. With dphase 1 and
    spikes only this is textbook GAE. A + V are the TD(lambda) targets of the value function.

    Args:
      rate: `[T]` continuous reward per unit of phase.
      spike: `[T]` reward received at once.
      dphase: `[T]` phase that went by.
      value: `[T]` V of the state before the step.
      next_value: `[T]` V of the state after the step, before any reset.
      terminated: `[T]` bool, the future is worth nothing.
      ended: `[T]` bool, the next row belongs to another episode.
      gamma: discount per unit of phase.
      lambda_: GAE parameter per unit of phase.
    """
    chex.assert_rank([rate, spike, dphase, value, next_value], 1)
    chex.assert_equal_shape([rate, spike, dphase, value, next_value, terminated, ended])
    future = jnp.where(terminated, 0.0, gamma**dphase * next_value)
    delta = discounted(rate, dphase, gamma) + spike + future - value
    carry_on = jnp.where(ended, 0.0, (gamma * lambda_) ** dphase)

    def back(following: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        advantage = row[0] + row[1] * following
        return advantage, advantage

    _, found = jax.lax.scan(back, jnp.zeros((), value.dtype), (delta, carry_on), reverse=True)
    return found
