# SPDX-License-Identifier: Apache-2.0
"""Environments whose values and best actions are known, and a small loop that learns them.

Each checks one link: reward to value, observation to value, discount, reward to action, both, and
time steps that vary. The loop is the library's own: rollout, batch, update.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jaxskills import trainer
from jaxskills.compilation import jit
from jaxskills.env.core import Environment, Outcome, Report
from jaxskills.learn import networks, normalize, ppo, rollout
from jaxskills.learn.networks import NetworkConfig, Networks
from jaxskills.learn.normalize import Normalizer
from jaxskills.learn.ppo import Learner, PPOConfig

GAMMA = 0.9
BEST = 0.5  # the action that pays most, times the observation where both matter


@struct.dataclass
class ProbeState:
    """What a probe remembers."""

    phase: jax.Array  # [] control frames, for the rollout
    side: jax.Array  # [] -1 or 1, drawn at the start
    step: jax.Array  # [] int32


class Probe(NamedTuple):
    """A probe: `obs(state) -> []`, `pay(state, action []) -> (rate, spike, dphase)`, its length."""

    obs: Callable[[ProbeState], jax.Array]
    pay: Callable[[ProbeState, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
    steps: int = 1
    truncated: bool = False  # at the end; else terminated


def _spike(value: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    return jnp.float32(0.0), jnp.asarray(value, jnp.float32), jnp.float32(1.0)


def _last(state: ProbeState) -> jax.Array:
    return jnp.float32(state.step)


CONSTANT = Probe(lambda s: jnp.float32(0.0), lambda s, a: _spike(jnp.float32(1.0)))
OBSERVED = Probe(lambda s: s.side, lambda s, a: _spike(s.side))
DELAYED = Probe(_last, lambda s, a: _spike(_last(s)), steps=2)
ACTION = Probe(lambda s: jnp.float32(0.0), lambda s, a: _spike(-((a - BEST) ** 2)))
BOTH = Probe(lambda s: s.side, lambda s, a: _spike(-((a - BEST * s.side) ** 2)))
# First 1 a frame over half a frame or over three, as shown, then 2 at once.
STRETCHED = Probe(
    lambda s: jnp.where(s.step == 0, s.side, 0.0),
    lambda s, a: (
        jnp.where(s.step == 0, 1.0, 0.0),
        jnp.where(s.step == 1, 2.0, 0.0),
        jnp.where((s.step == 0) & (s.side < 0), 0.5, jnp.where(s.step == 0, 3.0, 1.0)),
    ),
    steps=2,
)
# Pays 1 for ever, but is cut off after three steps.
CUT_OFF = Probe(lambda s: jnp.float32(0.0), lambda s, a: _spike(jnp.float32(1.0)), 3, True)


def environment(probe: Probe) -> Environment:
    """Returns the probe as an environment; starts in the second half of the phase have side 1."""
    nothing = jnp.float32(0.0)
    report = Report(
        nothing, nothing, jnp.bool_(True), jnp.bool_(False), jnp.int32(0), nothing, nothing
    )

    def start(phase: jax.Array) -> ProbeState:
        return ProbeState(phase, jnp.where(phase < 1.0, -1.0, 1.0), jnp.int32(0))

    def observe(state: ProbeState) -> jax.Array:
        return jnp.asarray(probe.obs(state), jnp.float32)[None]

    def step(state: ProbeState, action: jax.Array) -> tuple[ProbeState, Outcome]:
        rate, spike, dphase = probe.pay(state, action[0])
        state = ProbeState(state.phase + dphase, state.side, state.step + 1)
        over = state.step >= probe.steps
        terminated, truncated = over & (not probe.truncated), over & probe.truncated
        outcome = Outcome(observe(state), rate, spike, dphase, terminated, truncated, report)
        return state, outcome

    return Environment(start, None, observe, step, 1, ("diverged",), 2.0, 2.0)  # pyright: ignore


class Learnt(NamedTuple):
    """What came out of the loop."""

    networks: Networks
    learner: Learner
    normalizer: Normalizer

    def value(self, obs: float) -> float:
        """Returns the value of an observation."""
        return float(self.networks.value(self.learner.value, self._seen(obs)))

    def action(self, obs: float) -> float:
        """Returns the mean action at an observation."""
        return float(self.networks.mean(self.learner.policy, self._seen(obs))[0])

    def _seen(self, obs: float) -> jax.Array:
        return normalize.apply(self.normalizer, jnp.array([obs], jnp.float32))


def learn(probe: Probe, updates: int, envs: int = 32, horizon: int = 8) -> Learnt:
    """Returns what `updates` rounds of rollout and PPO make of a probe."""
    env = environment(probe)
    config = PPOConfig(GAMMA, 0.95, epochs=4, minibatch=64, policy_lr=3e-3, value_lr=3e-3)
    nets = networks.make(NetworkConfig((16,), (16,), noise=0.3), 1, 1, GAMMA)

    def starts(key: jax.Array) -> rollout.Fresh:
        return rollout.begin(env, 2.0 * jax.random.uniform(key, (envs,)))

    def round_(carry, key: jax.Array):
        learner, normalizer, current = carry
        start_key, act_key, learn_key = jax.random.split(key, 3)
        current, steps = rollout.collect(
            env, nets, learner.policy, normalizer, current, starts(start_key), act_key, horizon
        )
        batch = trainer.to_batch(config, nets, learner, normalizer, steps)
        learner, _ = ppo.update(config, nets, learner, batch, learn_key)
        normalizer = normalize.update(normalizer, steps.obs.reshape(-1, 1))
        return (learner, normalizer, current), None

    def run(key: jax.Array):
        init_key, start_key, key = jax.random.split(key, 3)
        current = starts(start_key)
        normalizer = normalize.update(normalize.init(1), current.obs)
        begin = ppo.init(config, nets, init_key), normalizer, current
        return jax.lax.scan(round_, begin, jax.random.split(key, updates))[0][:2]

    return Learnt(nets, *jit(run)(jax.random.key(0)))
