# SPDX-License-Identifier: Apache-2.0
"""Rollouts of a probe: rows follow one another, and ended episodes begin anew."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest

from jaxskills.learn import networks, normalize, rollout
from jaxskills.learn.networks import NetworkConfig, Networks
from jaxskills.learn.rollout import Transition

ENVS, HORIZON = 6, 5


@pytest.fixture(scope="module")
def nets() -> Networks:
    return networks.make(NetworkConfig((4,), (4,), noise=0.3), 1, 1, probes.GAMMA)


def _collect(
    nets: Networks, probe: probes.Probe, key: jax.Array, renewal: float = 0.0
) -> tuple[rollout.Fresh, Transition]:
    """Returns a rollout that begins on side -1; all fresh starts are on side 1."""
    env = probes.environment(probe)
    policy, _ = nets.init(jax.random.key(0))
    current, fresh = (rollout.begin(env, jnp.full(ENVS, phase)) for phase in (0.25, 1.5))
    return rollout.collect(
        env, nets, policy, normalize.init(1), current, fresh, key, HORIZON, renewal
    )


@pytest.mark.parametrize("probe", [probes.STRETCHED, probes.CUT_OFF])
def test_rows_follow_one_another_until_an_episode_ends(nets: Networks, probe: probes.Probe):
    last, steps = _collect(nets, probe, jax.random.key(1))
    ended = np.asarray(steps.terminated | steps.truncated)
    assert steps.obs.shape == (HORIZON, ENVS, 1)
    # Every episode has as many steps as the probe says.
    expected = (np.arange(HORIZON) % probe.steps == probe.steps - 1)[:, None]
    np.testing.assert_array_equal(ended, np.tile(expected, ENVS))
    flags = steps.truncated if probe.truncated else steps.terminated
    np.testing.assert_array_equal(flags, ended)
    phase = np.concatenate((steps.phase, np.asarray(last.state.phase)[None]))
    goes_on = phase[:-1] + np.asarray(steps.dphase)
    np.testing.assert_allclose(phase[1:], np.where(ended, 1.5, goes_on), atol=1e-6)
    obs = np.concatenate((steps.obs, np.asarray(last.obs)[None]))
    np.testing.assert_array_equal(obs[1:][~ended], np.asarray(steps.next_obs)[~ended])


def test_episodes_are_cut_off_for_new_starts(nets: Networks):
    """An endless probe goes on from a fresh start after a cut, and termination goes first."""
    endless = probes.CUT_OFF._replace(steps=1000)
    last, steps = _collect(nets, endless, jax.random.key(1), renewal=0.3)
    cut = np.asarray(steps.truncated)
    assert not np.asarray(steps.terminated).any()
    assert 0.3 * cut.size - 4 * np.sqrt(0.21 * cut.size) < cut.sum() < 0.3 * cut.size * 2
    following = np.concatenate((steps.phase, np.asarray(last.state.phase)[None]))[1:]
    np.testing.assert_array_equal(cut, following == 1.5)
    _, steps = _collect(nets, probes.DELAYED, jax.random.key(1), renewal=1.0)
    assert not (np.asarray(steps.truncated) & np.asarray(steps.terminated)).any()
    assert (np.asarray(steps.truncated) | np.asarray(steps.terminated)).all()


def test_what_is_seen_last_is_of_the_old_episode(nets: Networks):
    """`next_obs` is what the value of a cut off future needs: before the new start."""
    _, steps = _collect(nets, probes.DELAYED, jax.random.key(1))
    np.testing.assert_array_equal(steps.next_obs[1], np.full((ENVS, 1), 2.0))
    np.testing.assert_array_equal(steps.obs[2], np.zeros((ENVS, 1)))


def test_actions_are_the_mean_and_noise_and_their_chance_is_kept(nets: Networks):
    _, steps = _collect(nets, probes.OBSERVED, jax.random.key(1))
    policy, _ = nets.init(jax.random.key(0))
    mean = nets.mean(policy, steps.obs)
    np.testing.assert_allclose(
        steps.log_prob, networks.log_prob(steps.action, mean, nets.noise), rtol=1e-5
    )
    noise = np.asarray(steps.action - mean).ravel() / nets.noise
    assert len(set(noise.tolist())) == ENVS * HORIZON
    assert 0.5 < noise.std() < 1.5


def test_the_key_decides_the_noise(nets: Networks):
    actions = [
        np.asarray(_collect(nets, probes.OBSERVED, jax.random.key(seed))[1].action)
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.allclose(actions[0], actions[2])
