# SPDX-License-Identifier: Apache-2.0
"""Proximal policy optimisation on one batch of transitions (Schulman et al. 2017)."""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxskills.errors import UserError
from jaxskills.learn.networks import Networks, Params, log_prob

_LR_STEP, _LR_RANGE = 1.5, (1e-6, 1e-2)


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """How a batch is learnt from."""

    discount: float = 0.98  # per control frame; SB section 5: 0.95
    lambda_: float = 0.95  # SB section 5, for GAE and TD alike
    clip: float = 0.2
    epochs: int = 3
    minibatch: int = 512  # SB section 5: 256
    policy_lr: float = 5e-5  # Adam, to begin with
    value_lr: float = 1e-3  # Adam
    # The policy's step size follows the change it makes: down by a third where an update moves the
    # policy by more than twice this, up where by less than half of it. 0 keeps it as it is.
    target_kl: float = 0.03
    max_grad_norm: float = 10.0


@struct.dataclass
class Learner:
    """Both networks and their optimisers."""

    policy: Params
    value: Params
    policy_opt: optax.OptState
    value_opt: optax.OptState
    policy_lr: jax.Array  # []


@struct.dataclass
class Batch:
    """M transitions to learn from."""

    obs: jax.Array  # [M, O] normalised
    action: jax.Array  # [M, A]
    log_prob: jax.Array  # [M] when it was taken
    advantage: jax.Array  # [M]
    target: jax.Array  # [M] of the value function


def optimizers(
    config: PPOConfig,
) -> tuple[optax.GradientTransformation, optax.GradientTransformation]:
    """Returns the optimisers of the policy and of the value function."""
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    # The policy's step size is in the learner.
    policy = optax.chain(clip, optax.scale_by_adam(), optax.scale(-1.0))
    return policy, optax.chain(clip, optax.adam(config.value_lr))


def init(config: PPOConfig, networks: Networks, key: jax.Array) -> Learner:
    """Returns a fresh learner. The key is consumed."""
    policy, value = networks.init(key)
    policy_opt, value_opt = optimizers(config)
    states = policy_opt.init(policy), value_opt.init(value)
    return Learner(policy, value, *states, jnp.float32(config.policy_lr))


def policy_loss(
    params: Params, networks: Networks, batch: Batch, clip: float
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Returns the clipped surrogate loss and what to watch."""
    log_ratio = log_prob(batch.action, networks.mean(params, batch.obs), networks.noise)
    log_ratio -= batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    watched = {
        "kl": jnp.mean(ratio - 1.0 - log_ratio),
        "clipped": jnp.mean(jnp.abs(ratio - 1.0) > clip),
    }
    return -jnp.mean(gain), watched


def value_loss(params: Params, networks: Networks, batch: Batch) -> jax.Array:
    """Returns the mean squared error of the values, in units of the largest return squared."""
    scale = networks.value_scale
    return jnp.mean(((networks.value(params, batch.obs) - batch.target) / scale) ** 2)


def update(
    config: PPOConfig, networks: Networks, learner: Learner, batch: Batch, key: jax.Array
) -> tuple[Learner, dict[str, jax.Array]]:
    """Returns the learner after `epochs` passes over the batch, and means of what to watch.

    The key is consumed by the order of the minibatches.
    """
    policy_opt, value_opt = optimizers(config)
    size = batch.log_prob.shape[0]
    count = size // config.minibatch

    def minibatch_step(learner: Learner, rows: jax.Array) -> tuple[Learner, dict[str, jax.Array]]:
        part = jax.tree.map(lambda x: x[rows], batch)
        (_, watched), grad = jax.value_and_grad(policy_loss, has_aux=True)(
            learner.policy, networks, part, config.clip
        )
        step, policy_state = policy_opt.update(grad, learner.policy_opt, learner.policy)
        step = jax.tree.map(lambda x: learner.policy_lr * x, step)
        policy = optax.apply_updates(learner.policy, step)
        loss, grad = jax.value_and_grad(value_loss)(learner.value, networks, part)
        step, value_state = value_opt.update(grad, learner.value_opt, learner.value)
        value = optax.apply_updates(learner.value, step)
        watched["value_loss"] = loss
        return Learner(policy, value, policy_state, value_state, learner.policy_lr), watched

    keys = jax.random.split(key, config.epochs)
    order = jax.vmap(lambda k: jax.random.permutation(k, size))(keys)
    rows = order[:, : count * config.minibatch].reshape(-1, config.minibatch)
    learner, watched = jax.lax.scan(minibatch_step, learner, rows)
    lr = next_lr(config, learner.policy_lr, jnp.mean(watched["kl"][-count:]))
    learner = dataclasses.replace(learner, policy_lr=lr)
    return learner, jax.tree.map(jnp.mean, watched) | {"policy_lr": lr}


def next_lr(config: PPOConfig, lr: jax.Array, kl: jax.Array) -> jax.Array:
    """Returns the policy's next step size `[]`, after a last epoch with mean divergence `kl []`."""
    if config.target_kl == 0.0:
        return lr
    down, up = kl > 2.0 * config.target_kl, kl < 0.5 * config.target_kl
    factor = jnp.where(down, 1.0 / _LR_STEP, jnp.where(up, _LR_STEP, 1.0))
    return jnp.clip(lr * factor, *_LR_RANGE)


def validate(config: PPOConfig, batch_size: int) -> None:
    """Checks a configuration against the number of transitions in an update.

    Raises:
      UserError: a value out of range.
    """
    for name in ("discount", "lambda_"):
        value = getattr(config, name)
        if not 0 <= value <= 1 or (name == "discount" and value == 1):
            largest = "< 1" if name == "discount" else "<= 1"
            raise UserError(f"ppo.{name} is {value}: give 0 <= {name} {largest}")
    for name in ("clip", "policy_lr", "value_lr", "max_grad_norm"):
        if not getattr(config, name) > 0:
            raise UserError(f"ppo.{name} is {getattr(config, name)}: give a positive number")
    if not config.target_kl >= 0:
        raise UserError(f"ppo.target_kl is {config.target_kl}: give 0 (off) or more")
    if config.epochs < 1:
        raise UserError(f"ppo.epochs is {config.epochs}: give 1 or more")
    if not 1 <= config.minibatch <= batch_size:
        raise UserError(
            f"ppo.minibatch is {config.minibatch}: give 1 to {batch_size} (envs x horizon)"
        )
