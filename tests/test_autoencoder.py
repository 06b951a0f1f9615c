# SPDX-License-Identifier: Apache-2.0
"""The motion autoencoder: what a feature depends on, training on a tiny set, files."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxskills import character as character_lib
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import gram
from jaxskills.errors import UserError
from jaxskills.learn import autoencoder
from jaxskills.learn.autoencoder import Autoencoder, AutoencoderConfig

SMALL = AutoencoderConfig(channels=12, width=5, window=12, steps=60, batch=8, lr=3e-3)
BODIES = ("pelvis", "torso", "left_leg", "right_leg")


@pytest.fixture(scope="module")
def data() -> jax.Array:
    """Sines: 40 windows of 12 frames with 16 features."""
    random = np.random.default_rng(0)
    time = np.arange(12) + random.uniform(0, 30, (40, 1))
    amplitude, shift = random.normal(size=16), random.uniform(0, 6, 16)
    waves = amplitude * np.sin(2 * np.pi * time[..., None] / 30 + shift) + random.normal(size=16)
    return jnp.asarray(waves, jnp.float32)


@pytest.fixture(scope="module")
def model(data: jax.Array) -> Autoencoder:
    return autoencoder.init(SMALL, BODIES, data, jax.random.key(0))


@pytest.fixture(scope="module")
def trained(model: Autoencoder, data: jax.Array) -> tuple[Autoencoder, np.ndarray]:
    found, losses = autoencoder.train(SMALL, model, data, jax.random.key(1))
    return found, np.asarray(losses)


def test_shapes(model: Autoencoder, data: jax.Array):
    hidden = autoencoder.encode(model, data)
    assert model.width == 5
    assert hidden.shape == (40, 8, 12)
    assert float(hidden.min()) == 0.0 < float(hidden.max())
    assert autoencoder.decode(model, hidden).shape == data.shape
    assert autoencoder.encode(model, data[0]).shape == (8, 12)
    assert autoencoder.encode(model, data[0, :5]).shape == (1, 12)
    assert gram.matrix(hidden[0]).shape == (12, 12)


def test_a_feature_depends_on_the_frames_up_to_it(model: Autoencoder, data: jax.Array):
    hidden = autoencoder.encode(model, data[0])
    np.testing.assert_allclose(hidden[-1:], autoencoder.encode(model, data[0, -5:]), atol=1e-5)
    later = autoencoder.encode(model, data[0].at[9].add(3.0))
    np.testing.assert_allclose(later[:5], hidden[:5], atol=1e-6)
    assert np.abs(later[5:] - hidden[5:]).max(1).min() > 1e-3


def test_features_shift_with_the_motion(model: Autoencoder, data: jax.Array):
    whole = autoencoder.encode(model, data[0])
    np.testing.assert_allclose(autoencoder.encode(model, data[0, 3:]), whole[3:], atol=1e-5)


def test_style_does_not_ask_how_fast(model: Autoencoder, data: jax.Array):
    found = autoencoder.style(model, data)
    assert found.shape == (40, 8, 12)
    np.testing.assert_array_equal(found, autoencoder.style(model, data.at[..., -4:].set(9.0)))
    moved = autoencoder.style(model, data.at[..., 3].add(9.0))
    assert not np.allclose(found, moved, atol=0.1)
    at_mean = data.at[..., -4:].set(model.mean[-4:])
    np.testing.assert_allclose(found, autoencoder.encode(model, at_mean), atol=1e-6)


def test_inputs_are_scaled_by_group(data: jax.Array):
    """A feature that hardly moves is not blown up: positions share a scale, so do velocities."""
    quiet = data.at[..., 2].multiply(1e-3).at[..., 14].multiply(1e-3).at[..., 15].multiply(7.0)
    found = autoencoder.init(SMALL, BODIES, quiet, jax.random.key(0))
    assert len(set(np.asarray(found.scale[:12]).tolist())) == 1
    assert len(set(np.asarray(found.scale[12:15]).tolist())) == 1
    deviation = float(jnp.std(quiet[..., 15]))
    assert float(found.scale[15]) == pytest.approx(deviation, rel=1e-3)
    np.testing.assert_allclose(found.mean, jnp.mean(quiet, (0, 1)), atol=1e-5)


def test_training_lowers_the_loss_and_the_error(
    model: Autoencoder, trained: tuple[Autoencoder, np.ndarray], data: jax.Array
):
    found, losses = trained
    assert losses.shape == (60,) and np.isfinite(losses).all()
    assert losses[-5:].mean() < 0.5 * losses[:5].mean()
    before, after = (autoencoder.error(one, data) for one in (model, found))
    assert before.shape == (16,)
    assert float(jnp.sum(after**2)) < 0.5 * float(jnp.sum(before**2))


def test_the_same_seed_gives_the_same_bits(
    model: Autoencoder, trained: tuple[Autoencoder, np.ndarray], data: jax.Array
):
    again, losses = autoencoder.train(SMALL, model, data, jax.random.key(1))
    np.testing.assert_array_equal(losses, trained[1])
    jax.tree.map(np.testing.assert_array_equal, again.params, trained[0].params)
    other, _ = autoencoder.train(SMALL, model, data, jax.random.key(2))
    assert not np.array_equal(
        other.params["encoder"]["kernel"], trained[0].params["encoder"]["kernel"]
    )


def test_the_error_is_of_the_inner_frames(model: Autoencoder, data: jax.Array):
    """Frames 4 to 7 of 12 are reached by all filters of 5."""
    wrong = autoencoder.decode(model, autoencoder.encode(model, data)) - data
    expected = np.sqrt(np.mean(np.asarray(wrong)[:, 4:8] ** 2, (0, 1)))
    np.testing.assert_allclose(autoencoder.error(model, data), expected, rtol=1e-5)


def test_a_file_holds_it_all(model: Autoencoder, who: Character, tmp_path: Path):
    path = autoencoder.save(model, tmp_path / "some.npz")
    found = autoencoder.load(path, who)
    assert found.bodies == who.body_names
    jax.tree.map(np.testing.assert_array_equal, found, model)


def test_the_shipped_one_is_small_and_sees_styles():
    """It belongs to `humanoid34`; features of standing still and of the zero pose turned agree."""
    path = autoencoder.shipped()
    assert path.stat().st_size < 2_000_000
    humanoid = character_lib.load("humanoid34")
    model = autoencoder.load(path, humanoid)
    still = jnp.asarray(humanoid.model.qpos0, jnp.float32)
    turned = still.at[3:7].set(jnp.array([0.6, 0.0, 0.0, 0.8]))
    bent = still.at[humanoid.layout.joints[1].qpos + jnp.arange(4)].set(
        jnp.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0])
    )
    poses = jnp.stack([jnp.tile(q, (model.width, 1)) for q in (still, turned, bent)])
    frames = jax.vmap(lambda q: gram.frames_of(humanoid, q, jnp.zeros((len(q), 34))))
    hidden = jit(lambda q: autoencoder.style(model, frames(q)))(poses)
    styles = [gram.matrix(h) for h in hidden]
    assert float(gram.distance(styles[0], styles[1])) < 1e-3
    assert float(gram.distance(styles[0], styles[2])) > 0.02


def test_files_that_are_none(model: Autoencoder, who: Character, tmp_path: Path):
    broken, lacking = tmp_path / "broken.npz", tmp_path / "lacking.npz"
    broken.write_bytes(b"PK\x03\x04 cut off")
    np.savez(lacking, bodies=np.array(BODIES))
    other = autoencoder.save(
        dataclasses.replace(model, bodies=("trunk", *BODIES[1:])), tmp_path / "other.npz"
    )
    for path, says in (
        (tmp_path / "none.npz", "does not exist"),
        (broken, "is not a sound npz file"),
        (lacking, "is not a sound npz file"),
        (other, "knows the bodies trunk, torso, left_leg, right_leg, character 'walker'"),
    ):
        with pytest.raises(UserError) as raised:
            autoencoder.load(path, who)
        assert says in str(raised.value) and str(path) in str(raised.value)
        assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="saved as .npz, not '.*some.txt'"):
        autoencoder.save(model, tmp_path / "some.txt")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"channels": 0}, "autoencoder.channels is 0: give 1 or more"),
        ({"steps": -1}, "autoencoder.steps is -1: give 1 or more"),
        ({"window": 8}, "autoencoder.window is 8: give 9 frames or more"),
        ({"speeds": (1.0, 0.0)}, r"autoencoder.speeds is \(1.0, 0.0\): give positive numbers"),
        ({"dropout": 1.0}, "autoencoder.dropout is 1.0: give 0 <= dropout < 1"),
        ({"sparsity": -1.0}, "autoencoder.sparsity is -1.0: give 0 or more"),
        ({"lr": float("nan")}, "autoencoder.lr is nan: give a positive number"),
    ],
)
def test_out_of_range(change: dict, says: str):
    with pytest.raises(UserError, match=says):
        autoencoder.validate(dataclasses.replace(SMALL, **change))
