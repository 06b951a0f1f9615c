# SPDX-License-Identifier: Apache-2.0
"""Both networks: shapes, where they begin, their units, and the density of an action."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxskills.errors import UserError
from jaxskills.learn import networks
from jaxskills.learn.networks import NetworkConfig, Networks

SMALL = NetworkConfig(policy=(8, 4), value=(6,), noise=0.2)


@pytest.fixture(scope="module")
def nets() -> Networks:
    return networks.make(SMALL, obs_size=5, action_size=3, discount=0.98)


def test_shapes(nets: Networks):
    policy, value = nets.init(jax.random.key(0))
    sizes = lambda params: sorted(x.shape for x in jax.tree.leaves(params) if x.ndim == 2)  # noqa: E731
    assert sizes(policy) == [(4, 3), (5, 8), (8, 4)]
    assert sizes(value) == [(5, 6), (6, 1)]
    obs = jnp.ones((2, 7, 5))
    assert nets.mean(policy, obs).shape == (2, 7, 3)
    assert nets.value(value, obs).shape == (2, 7)


def test_actions_begin_near_zero_and_values_near_nothing(nets: Networks):
    policy, value = nets.init(jax.random.key(0))
    obs = jax.random.normal(jax.random.key(1), (200, 5))
    mean, worth = nets.mean(policy, obs), nets.value(value, obs)
    assert 0.0 < float(jnp.abs(mean).max()) < 0.2
    assert 0.0 < float(jnp.abs(worth).max()) < 0.2 * nets.value_scale


def test_values_are_in_units_of_the_largest_return(nets: Networks):
    assert nets.value_scale == pytest.approx(50.0)
    other = networks.make(SMALL, 5, 3, discount=0.9)
    _, value = nets.init(jax.random.key(0))
    obs = jnp.ones((1, 5))
    ratio = nets.value(value, obs) / other.value(value, obs)
    np.testing.assert_allclose(ratio, 5.0, rtol=1e-5)


def test_keys_decide_the_parameters(nets: Networks):
    same = jax.tree.map(np.array_equal, nets.init(jax.random.key(0)), nets.init(jax.random.key(0)))
    assert all(jax.tree.leaves(same))
    (a, va), (b, _) = nets.init(jax.random.key(0)), nets.init(jax.random.key(1))
    kernel = lambda params: np.asarray(params["params"]["Dense_0"]["kernel"])  # noqa: E731
    assert not np.allclose(kernel(a), kernel(b))
    assert not np.allclose(kernel(a)[:, :6], kernel(va))


def test_hidden_layers_are_orthogonal(nets: Networks):
    policy, _ = nets.init(jax.random.key(0))
    kernel = np.asarray(policy["params"]["Dense_1"]["kernel"])
    np.testing.assert_allclose(kernel.T @ kernel, 2.0 * np.eye(4), atol=1e-5)


def test_log_prob_is_the_gaussian_density_up_to_a_constant():
    rng = np.random.default_rng(0)
    action, mean = rng.normal(size=(2, 6, 3))
    found = np.asarray(networks.log_prob(jnp.asarray(action), jnp.asarray(mean), 0.7))
    density = multivariate_normal(np.zeros(3), 0.49 * np.eye(3)).logpdf(action - mean)
    np.testing.assert_allclose(found - found[0], density - density[0], rtol=1e-4, atol=1e-4)
    assert networks.log_prob(jnp.asarray(mean), jnp.asarray(mean), 0.7).tolist() == [0.0] * 6


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            NetworkConfig(policy=()),
            "networks.policy is (): give positive layer sizes, like 512 256",
        ),
        (NetworkConfig(value=(8, 0)), "networks.value is (8, 0): give positive layer sizes"),
        (
            NetworkConfig(noise=0.0),
            "networks.noise is 0.0: give a standard deviation in (0, 10] rad",
        ),
        (NetworkConfig(noise=11.0), "networks.noise is 11.0: give"),
        (NetworkConfig(noise=float("nan")), "networks.noise is nan: give"),
    ],
)
def test_what_is_no_network_is_refused(config: NetworkConfig, message: str):
    with pytest.raises(UserError) as raised:
        networks.make(config, 5, 3, 0.98)
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)
