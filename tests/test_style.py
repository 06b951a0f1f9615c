# SPDX-License-Identifier: Apache-2.0
"""Style rewards: hull volumes against scipy, energy against C MuJoCo, rewards by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from jaxskills.env import style
from jaxskills.env.style import StyleConfig
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies, BodyParams

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)


def test_the_volume_of_a_cube():
    """Six faces of four points each, every one of which could be cut in two ways."""
    assert float(style.hull_volume(jnp.asarray(CUBE))) == pytest.approx(1.0, abs=2e-3)


def test_a_flat_cloud_has_no_volume():
    points = np.random.default_rng(0).normal(size=(12, 3)) * [1, 1, 0]
    assert float(style.hull_volume(jnp.asarray(points, jnp.float32))) == pytest.approx(0, abs=3e-3)


@pytest.mark.parametrize("count", [4, 8, 15, 20])
def test_volumes_are_those_of_scipy(count: int):
    random = np.random.default_rng(count)
    clouds = random.normal(size=(20, count, 3)) * [0.3, 0.2, 0.6] + [5.0, 0.0, 1.0]
    found = jax.jit(jax.vmap(style.hull_volume))(jnp.asarray(clouds, jnp.float32))
    expected = [ConvexHull(cloud).volume for cloud in clouds]
    np.testing.assert_allclose(found, expected, atol=1e-3)


def _still(pos: np.ndarray) -> Bodies:
    count, zero = len(pos), jnp.zeros
    return Bodies(jnp.asarray(pos), zero((count, 3, 3)), *[zero((count, 3))] * 2, zero(3), zero(3))


@pytest.mark.parametrize(
    ("kind", "level", "expected"),
    [
        ("energy_up", 20.0, 0.0),
        ("energy_up", 60.0, 0.5),
        ("energy_up", 500.0, 1.0),
        ("energy_down", 0.0, 1.0),
        ("energy_down", 40.0, 0.75),
        ("energy_down", 100.0, 0.0),
        ("volume_down", 0.0, np.exp(-1 / 0.12)),
        ("volume_up", 0.0, 1.0 - np.exp(-1 / 0.12)),
    ],
)
def test_style_by_hand(kind, level: float, expected: float):
    config = StyleConfig(style=kind)
    found = style._style(config, jnp.float32(level), _still(CUBE))
    assert float(found) == pytest.approx(expected, abs=2e-3)


def test_the_regulariser_by_hand():
    """400 J of 400, one of 8 bodies at 100 m/s^2 of 100, one of 3 joints at 200 of 400 rad/s^2:
    (1 + 1 + 0.5) / 12."""
    before = _still(CUBE)
    after = dataclasses.replace(before, lin=before.lin.at[2, 1].set(100.0 / 30.0))
    joints = jnp.array([0.0, 200.0, 0.0])
    found = style._regulariser(StyleConfig(), jnp.float32(400.0), after, before, joints)
    assert float(found) == pytest.approx(np.exp(-2.5 / 12), abs=1e-5)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"energy": (5.0, 5.0)}, "style.energy is"),
        ({"volume": 0.0}, "style.volume is 0.0"),
        ({"gram": -1.0}, "style.gram is -1.0: give a positive number"),
        ({"style": "gram"}, "style.style is gram, style.style_clip is None: gram needs the clip"),
        ({"style": "energy_up", "style_clip": "walk"}, "style.style is energy_up, .* is walk"),
        ({"look_back": 0.0}, "style.look_back is 0.0: give 1/30 to 60 s, or None"),
        ({"look_back": float("nan")}, "style.look_back is nan"),
    ],
)
def test_out_of_range(change: dict, says: str):
    with pytest.raises(UserError, match=says) as raised:
        style.validate(StyleConfig(**change))
    assert "\n" not in str(raised.value)


def test_likeness_takes_the_place_of_the_style():
    """Still bodies have no energy and no accelerations, so the regulariser is 1."""
    bodies = _still(CUBE)
    zero, count = jnp.zeros, len(CUBE)
    params = BodyParams(
        *(zero((count + 1, 3)), zero((count + 1, 3, 3)), zero((1, 3)), zero((1, 3))),
        *(jnp.ones(count), zero((count, 3)), zero((count, 3)), zero((count, 3, 3))),
    )
    config = StyleConfig(style="gram", style_clip="some")
    found = style.reward(config, params, bodies, bodies, zero(3), jnp.float32(0.7))
    assert float(found) == pytest.approx(0.7)
