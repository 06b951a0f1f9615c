# SPDX-License-Identifier: Apache-2.0
"""Rollouts: B environments step together and begin anew where they end."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills.env.core import Environment, Outcome
from jaxskills.learn import normalize
from jaxskills.learn.networks import Networks, Params, log_prob


@struct.dataclass
class Fresh:
    """Starts to draw from when an episode ends."""

    state: Any  # EnvState [B]
    obs: jax.Array  # [B, O]


@struct.dataclass
class Transition:
    """T steps of B environments. Observations are raw."""

    obs: jax.Array  # [T, B, O] before the step
    next_obs: jax.Array  # [T, B, O] after it, before any new start
    phase: jax.Array  # [T, B] before the step
    state: Any  # EnvState [T, B] before the step
    action: jax.Array  # [T, B, A]
    log_prob: jax.Array  # [T, B]
    rate: jax.Array  # [T, B]
    spike: jax.Array  # [T, B]
    dphase: jax.Array  # [T, B]
    terminated: jax.Array  # [T, B] bool
    truncated: jax.Array  # [T, B] bool
    ended_by: jax.Array  # [T, B] int32


def begin(env: Environment, phase: jax.Array, variant: jax.Array | None = None) -> Fresh:
    """Returns starts on the reference at `phase [B]`, of variants `[B]` or of the only one."""
    own = () if variant is None else (variant,)
    return _observed(env, jax.vmap(env.start)(phase, *own))


def begin_at(env: Environment, phase: jax.Array, qpos: jax.Array, qvel: jax.Array) -> Fresh:
    """Returns starts at `phase [B]` in the states `qpos [B, nq]` and `qvel [B, nv]`."""
    return _observed(env, jax.vmap(env.place)(phase, qpos, qvel))


def _observed(env: Environment, state: Any) -> Fresh:
    return Fresh(state, jax.vmap(env.observe)(state))


def collect(
    env: Environment,
    networks: Networks,
    policy: Params,
    normalizer: normalize.Normalizer,
    current: Fresh,
    fresh: Fresh,
    key: jax.Array,
    horizon: int,
    renewal: float = 0.0,
    mixed: bool = True,
) -> tuple[Fresh, Transition]:
    """Returns the environments after `horizon` steps and all transitions on the way.

    An environment whose episode ends goes on from a random row of `fresh`, or from its own if they
    are not `mixed`, and so does one whose episode is cut off, with chance `renewal` in each step.
    The key is consumed.
    """
    count = current.obs.shape[0]
    noise_key, row_key, cut_key = jax.random.split(key, 3)
    noise = networks.noise * jax.random.normal(noise_key, (horizon, count, env.action_size))
    rows = jax.random.randint(row_key, (horizon, count), 0, count)
    rows = rows if mixed else jnp.broadcast_to(jnp.arange(count), rows.shape)
    cuts = jax.random.bernoulli(cut_key, renewal, (horizon, count))

    def advance(
        now: Fresh, drawn: tuple[jax.Array, jax.Array, jax.Array]
    ) -> tuple[Fresh, Transition]:
        noise, row, cut = drawn
        mean = networks.mean(policy, normalize.apply(normalizer, now.obs))
        action = mean + noise
        state, outcome = jax.vmap(env.step)(now.state, action)
        truncated = outcome.truncated | (cut & ~outcome.terminated)
        outcome = dataclasses.replace(outcome, truncated=truncated)
        transition = _transition(now, outcome, action, log_prob(action, mean, networks.noise))
        ended = outcome.terminated | outcome.truncated
        following = Fresh(state, outcome.obs)
        return _where(ended, jax.tree.map(lambda x: x[row], fresh), following), transition

    return jax.lax.scan(advance, current, (noise, rows, cuts))


def _transition(now: Fresh, outcome: Outcome, action: jax.Array, chance: jax.Array) -> Transition:
    return Transition(
        obs=now.obs,
        next_obs=outcome.obs,
        phase=now.state.phase,
        state=now.state,
        action=action,
        log_prob=chance,
        rate=outcome.rate,
        spike=outcome.spike,
        dphase=outcome.dphase,
        terminated=outcome.terminated,
        truncated=outcome.truncated,
        ended_by=outcome.report.ended_by,
    )


def _where(mask: jax.Array, new: Any, old: Any) -> Any:
    """Returns rows `[B, ...]` of `new` where `mask [B]`, else of `old`."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, new, old)
