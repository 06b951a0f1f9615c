# SPDX-License-Identifier: Apache-2.0
"""Motions that are asked for lean back to the reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills import variation
from jaxskills.errors import UserError
from jaxskills.explore import lean
from jaxskills.explore.lean import LeanConfig
from jaxskills.variation import Variation

NV, KNOTS, COUNT = 9, 4, 200
rng = np.random.default_rng(0)
MADE = Variation(
    jnp.float32(rng.normal(size=(COUNT, KNOTS, NV))), jnp.float32(rng.normal(size=(COUNT, KNOTS)))
)
X = variation.flatten(MADE)


def test_joints_are_displaced_less_and_all_along_the_motion():
    config = LeanConfig(share=0.25, most=0.6)
    after = variation.unflatten(lean.lean(config, X, NV, jax.random.key(1)), NV)
    np.testing.assert_array_equal(after.tau, MADE.tau)
    np.testing.assert_array_equal(after.d[..., :6], MADE.d[..., :6])
    factor = np.asarray(after.d[..., 6:] / MADE.d[..., 6:])
    np.testing.assert_allclose(factor, np.broadcast_to(factor[:, :1], factor.shape), rtol=1e-5)
    leans = (factor[:, 0] != 1.0).all(1)
    assert (factor[~leans] == 1.0).all()
    assert 0.15 < leans.mean() < 0.35
    some = factor[leans, 0]
    assert 0.4 <= some.min() < 0.45 and 0.95 < some.max() <= 1.0
    assert np.std(some, axis=1).min() > 0.0, "each axis has its own"


@pytest.mark.parametrize("config", [LeanConfig(share=0.0), LeanConfig(most=0.0)])
def test_off(config: LeanConfig):
    np.testing.assert_array_equal(lean.lean(config, X, NV, jax.random.key(0)), X)


def test_the_reference_stays():
    nothing = jnp.zeros_like(X)
    assert not np.asarray(lean.lean(LeanConfig(1.0, 1.0), nothing, NV, jax.random.key(0))).any()


@pytest.mark.parametrize("changes", [{"share": 1.5}, {"most": -0.1}, {"most": float("nan")}])
def test_out_of_range(changes):
    (name,) = changes
    with pytest.raises(UserError, match=f"lean.{name} is .*: give 0 to 1"):
        lean.validate(LeanConfig(**changes))
