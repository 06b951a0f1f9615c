# SPDX-License-Identifier: Apache-2.0
"""PPO: probes with known answers, and its parts one by one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import BEST, GAMMA

from jaxskills.compilation import jit
from jaxskills.errors import UserError
from jaxskills.learn import networks, ppo
from jaxskills.learn.networks import NetworkConfig, Networks
from jaxskills.learn.ppo import Batch, PPOConfig

CONFIG = PPOConfig(epochs=3, minibatch=4, policy_lr=1e-2, value_lr=1e-2)


def test_probe_constant_reward():
    assert probes.learn(probes.CONSTANT, 60).value(0.0) == pytest.approx(1.0, abs=0.1)


def test_probe_reward_shown_by_the_observation():
    learnt = probes.learn(probes.OBSERVED, 80)
    assert learnt.value(-1.0) == pytest.approx(-1.0, abs=0.1)
    assert learnt.value(1.0) == pytest.approx(1.0, abs=0.1)


def test_probe_delayed_reward_is_discounted():
    learnt = probes.learn(probes.DELAYED, 80)
    assert learnt.value(1.0) == pytest.approx(1.0, abs=0.04)
    assert learnt.value(0.0) == pytest.approx(GAMMA, abs=0.04)


def test_probe_reward_for_an_action():
    assert probes.learn(probes.ACTION, 100).action(0.0) == pytest.approx(BEST, abs=0.07)


def test_probe_reward_for_an_action_that_depends_on_the_observation():
    learnt = probes.learn(probes.BOTH, 150)
    assert learnt.action(-1.0) == pytest.approx(-BEST, abs=0.07)
    assert learnt.action(1.0) == pytest.approx(BEST, abs=0.07)


def test_probe_time_steps_of_different_lengths():
    learnt = probes.learn(probes.STRETCHED, 150)
    for side, dphase in ((-1.0, 0.5), (1.0, 3.0)):
        rate = (GAMMA**dphase - 1.0) / np.log(GAMMA)
        assert learnt.value(side) == pytest.approx(rate + 2.0 * GAMMA**dphase, abs=0.1)
    assert learnt.value(0.0) == pytest.approx(2.0, abs=0.1)


def test_probe_cut_off_episodes_are_worth_their_unseen_future():
    value = probes.learn(probes.CUT_OFF, 150).value(0.0)
    assert value == pytest.approx(1.0 / (1.0 - GAMMA), rel=0.05)


@pytest.fixture(scope="module")
def nets() -> Networks:
    return networks.make(NetworkConfig((8,), (8,), noise=0.1), 2, 3, 0.9)


def _batch(nets: Networks, learner: ppo.Learner, size: int = 16) -> Batch:
    keys = jax.random.split(jax.random.key(7), 4)
    obs = jax.random.normal(keys[0], (size, 2))
    mean = nets.mean(learner.policy, obs)
    action = mean + nets.noise * jax.random.normal(keys[1], mean.shape)
    chance = networks.log_prob(action, mean, nets.noise)
    advantage, target = jax.random.normal(keys[2], (2, size))
    return Batch(obs, action, chance, advantage, target)


def _same(a, b) -> bool:
    return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), a, b)))


def test_without_advantage_the_policy_stays_and_the_values_learn(nets: Networks):
    learner = ppo.init(CONFIG, nets, jax.random.key(0))
    batch = dataclasses.replace(_batch(nets, learner), advantage=jnp.zeros(16))
    after, watched = ppo.update(CONFIG, nets, learner, batch, jax.random.key(1))
    assert _same(after.policy, learner.policy)
    assert not _same(after.value, learner.value)
    assert (float(watched["kl"]), float(watched["clipped"])) == (0.0, 0.0)


def test_an_update_makes_good_actions_likelier_and_values_truer(nets: Networks):
    learner = ppo.init(CONFIG, nets, jax.random.key(0))
    batch = _batch(nets, learner)
    after, watched = ppo.update(CONFIG, nets, learner, batch, jax.random.key(1))
    chance = networks.log_prob(batch.action, nets.mean(after.policy, batch.obs), nets.noise)
    assert float(jnp.mean((chance - batch.log_prob) * batch.advantage)) > 0.0
    losses = [float(ppo.value_loss(x.value, nets, batch)) for x in (learner, after)]
    assert losses[1] < losses[0]
    assert float(watched["kl"]) > 0.0


def test_the_loss_is_clipped_by_hand(nets: Networks):
    """Ratios 1.5, 0.5, 1.5, 0.5 under advantages 1, 1, -1, -1: a gain stops at 1.2 and 0.8 where
    the step has gone far enough, and never where it went wrong."""
    learner = ppo.init(CONFIG, nets, jax.random.key(0))
    batch = _batch(nets, learner, 4)
    ratio = jnp.array([1.5, 0.5, 1.5, 0.5])
    batch = dataclasses.replace(
        batch,
        log_prob=batch.log_prob - jnp.log(ratio),
        advantage=jnp.array([1.0, 1.0, -1.0, -1.0]),
    )
    loss, watched = ppo.policy_loss(learner.policy, nets, batch, 0.2)
    assert float(loss) == pytest.approx(-(1.2 + 0.5 - 1.5 - 0.8) / 4, abs=1e-4)
    assert float(watched["clipped"]) == 1.0
    expected = np.mean([r - 1.0 - np.log(r) for r in (1.5, 0.5, 1.5, 0.5)])
    assert float(watched["kl"]) == pytest.approx(expected, abs=1e-4)


def test_the_value_loss_is_in_units_of_the_largest_return(nets: Networks):
    learner = ppo.init(CONFIG, nets, jax.random.key(0))
    batch = _batch(nets, learner)
    batch = dataclasses.replace(batch, target=nets.value(learner.value, batch.obs) + 2.0)
    # The largest return is 10.
    assert float(ppo.value_loss(learner.value, nets, batch)) == pytest.approx(0.04, rel=1e-3)


def _visits(size: int, key: jax.Array) -> list[list[int]]:
    """Returns the rows of each minibatch that an update shows to the policy, in order."""
    shown: list[list[int]] = []

    def mean(params: jax.Array, obs: jax.Array) -> jax.Array:
        shown.append([int(x) for x in np.asarray(obs[:, 0])])
        return obs * params

    spy = Networks(
        init=lambda key: (jnp.zeros(1), jnp.zeros(1)),
        mean=mean,
        value=lambda params, obs: obs[:, 0] * params[0],
        noise=1.0,
        value_scale=1.0,
    )
    learner = ppo.init(CONFIG, spy, jax.random.key(0))
    rows, ones = jnp.arange(float(size))[:, None], jnp.ones(size)
    with jax.disable_jit():
        ppo.update(CONFIG, spy, learner, Batch(rows, rows, ones, ones, ones), key)
    return shown


def test_each_epoch_sees_every_row_once_in_an_order_of_its_own():
    shown = _visits(12, jax.random.key(0))
    assert [len(part) for part in shown] == [4] * 9
    epochs = [sum(shown[i : i + 3], []) for i in (0, 3, 6)]
    assert [sorted(rows) for rows in epochs] == [list(range(12))] * 3
    assert epochs[0] != epochs[1] != epochs[2] != epochs[0]
    assert list(range(12)) not in epochs


def test_the_order_follows_from_the_key():
    assert _visits(12, jax.random.key(0)) == _visits(12, jax.random.key(0))
    assert _visits(12, jax.random.key(0)) != _visits(12, jax.random.key(1))


def test_what_does_not_fill_a_minibatch_waits_for_another_epoch():
    shown = _visits(14, jax.random.key(0))
    assert [len(part) for part in shown] == [4] * 9
    assert all(len(set(sum(shown[i : i + 3], []))) == 12 for i in (0, 3, 6))


def test_a_large_gradient_is_cut_to_its_greatest_norm(nets: Networks):
    """Adam hides the size of a gradient, its first moment does not."""
    config = dataclasses.replace(CONFIG, max_grad_norm=1e-3, epochs=1, minibatch=16)
    learner = ppo.init(config, nets, jax.random.key(0))
    after, _ = ppo.update(config, nets, learner, _batch(nets, learner), jax.random.key(1))
    (moments,) = (
        x.mu for x in jax.tree.leaves(after.policy_opt, is_leaf=lambda x: hasattr(x, "mu"))
        if hasattr(x, "mu")
    )  # fmt: skip
    norm = np.sqrt(sum(float(jnp.sum(x**2)) for x in jax.tree.leaves(moments)))
    assert norm == pytest.approx(0.1 * 1e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("kl", "expected"), [(0.061, 2e-3), (0.059, 3e-3), (0.016, 3e-3), (0.014, 4.5e-3)]
)
def test_the_step_size_follows_the_change_of_the_policy(kl: float, expected: float):
    """Down by a third above 0.06, up by half below 0.015: twice and half of the target."""
    lr = ppo.next_lr(PPOConfig(target_kl=0.03), jnp.float32(3e-3), jnp.float32(kl))
    assert float(lr) == pytest.approx(expected, rel=1e-5)
    assert float(ppo.next_lr(PPOConfig(target_kl=0.0), jnp.float32(3e-3), jnp.float32(kl))) == (
        pytest.approx(3e-3)
    )


def test_jitted_and_plain_updates_agree(nets: Networks):
    learner = ppo.init(CONFIG, nets, jax.random.key(0))
    batch, key = _batch(nets, learner), jax.random.key(1)
    plain, _ = ppo.update(CONFIG, nets, learner, batch, key)
    compiled, _ = jit(lambda a, b, k: ppo.update(CONFIG, nets, a, b, k))(learner, batch, key)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-4), plain, compiled)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"discount": 1.0}, "ppo.discount is 1.0: give 0 <= discount < 1"),
        ({"discount": -0.1}, "ppo.discount is -0.1: give 0 <= discount < 1"),
        ({"discount": float("nan")}, "ppo.discount is nan: give 0 <= discount < 1"),
        ({"clip": 0.0}, "ppo.clip is 0.0: give a positive number"),
        ({"policy_lr": -1.0}, "ppo.policy_lr is -1.0: give a positive number"),
        ({"value_lr": 0.0}, "ppo.value_lr is 0.0: give a positive number"),
        ({"max_grad_norm": 0.0}, "ppo.max_grad_norm is 0.0: give a positive number"),
        ({"epochs": 0}, "ppo.epochs is 0: give 1 or more"),
        ({"minibatch": 0}, "ppo.minibatch is 0: give 1 to 100 (envs x horizon)"),
        ({"minibatch": 101}, "ppo.minibatch is 101: give 1 to 100 (envs x horizon)"),
    ],
)
def test_what_is_out_of_range_is_refused(changes: dict, message: str):
    with pytest.raises(UserError) as raised:
        ppo.validate(PPOConfig(**({"minibatch": 50} | changes)), 100)
    assert str(raised.value) == message


def test_lambda_may_be_1_but_no_more():
    ppo.validate(PPOConfig(lambda_=1.0), 4096)
    with pytest.raises(UserError, match=r"ppo\.lambda_ is 1\.5: give 0 <= lambda_ <= 1"):
        ppo.validate(PPOConfig(lambda_=1.5), 4096)
