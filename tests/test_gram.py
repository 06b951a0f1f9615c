# SPDX-License-Identifier: Apache-2.0
"""Gram matrices by hand, windows against the reference they look back on, the style reward."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import kinematics, rotation
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, core, gram, variants
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig
from jaxskills.env.style import StyleConfig
from jaxskills.errors import UserError
from jaxskills.motion import Motion, sample
from jaxskills.physics import Physics
from jaxskills.physics.base import SimState, start

WIDTH, CHANNELS = 4, 6
ALPHA = 0.4


@pytest.fixture(scope="module")
def encode(who: Character) -> Callable[[jax.Array], jax.Array]:
    """Random filters over time."""
    size = 3 * len(who.body_names) + 4
    filters = np.random.default_rng(0).normal(size=(WIDTH, size, CHANNELS)).astype(np.float32)

    def filtered(frames: jax.Array) -> jax.Array:
        count = frames.shape[0] - WIDTH + 1
        return jax.nn.relu(
            sum(frames[i : i + count] @ jnp.asarray(filters[i]) for i in range(WIDTH))
        )

    return filtered


def _walk(who: Character, roll: int = 0, swing: float = 1.0) -> Motion:
    """Returns the walk of 30 frames, begun `roll` frames later, with wider or narrower steps."""
    qpos = tiny.walking()
    qpos[:, tiny.LEFT_HIP :] *= swing
    begun = np.concatenate((qpos[roll:-1], qpos[: roll + 1]))
    begun[:, 0] = qpos[:, 0]
    return tiny.make_motion(who, begun, True)


def _bound(who: Character) -> Motion:
    """Returns a motion on the spot, legs together, up and down."""
    qpos = tiny.standing(31)
    swing = np.sin(np.linspace(0.0, 4.0 * np.pi, 31))
    qpos[:, 2] += 0.1 * swing**2
    qpos[:, tiny.LEFT_HIP] = qpos[:, tiny.RIGHT_HIP] = 0.5 * swing
    return tiny.make_motion(who, qpos, True)


@pytest.fixture(scope="module")
def walk(who: Character) -> Motion:
    return _walk(who)


@pytest.fixture(scope="module")
def look(who: Character) -> Callable[[Motion], jax.Array]:
    """Motion to the features of its poses, compiled once."""
    compiled = jit(lambda qpos, qvel: gram.frames_of(who, qpos, qvel))
    return lambda motion: compiled(motion.qpos, motion.qvel)


@pytest.fixture(scope="module")
def same(who: Character, walk: Motion, encode) -> gram.Style:
    """The walk's own style, for the walk."""
    return gram.make(who, walk, walk, encode, WIDTH)


@pytest.fixture(scope="module")
def other(who: Character, walk: Motion, encode) -> gram.Style:
    """The walk's style, for one who hops."""
    return gram.make(who, _bound(who), walk, encode, WIDTH)


# The matrix and the distance


def test_a_gram_matrix_by_hand():
    """((1, 0) (1, 0)^T + (1, 2) (1, 2)^T) / 2."""
    found = gram.matrix(jnp.array([[1.0, 0.0], [1.0, 2.0]]))
    np.testing.assert_array_equal(found, [[1.0, 1.0], [1.0, 2.0]])


def test_a_gram_matrix_does_not_ask_when_nor_how_long():
    hidden = np.random.default_rng(1).uniform(size=(12, 5)).astype(np.float32)
    expected = gram.matrix(jnp.asarray(hidden))
    np.testing.assert_allclose(gram.matrix(jnp.asarray(hidden[::-1])), expected, rtol=1e-5)
    np.testing.assert_allclose(gram.matrix(jnp.tile(hidden, (3, 1))), expected, rtol=1e-5)


def test_the_distance_by_hand():
    """Between matrices of norm 1; of nothing, 1 from all."""
    target = jnp.array([[3.0, 0.0], [0.0, 4.0]])  # of norm 5
    other = jnp.array([[4.0, 0.0], [0.0, 3.0]])
    for a, b, expected in (
        (target, target, 0.0),
        (target, 7 * target, 0.0),
        (target, other, np.sqrt(2) / 5),
        (other, 3 * target, np.sqrt(2) / 5),
        (jnp.diag(jnp.array([2.0, 0.0])), jnp.diag(jnp.array([0.0, 1.0])), np.sqrt(2)),
        (target, 0 * target, 1.0),
    ):
        assert float(gram.distance(a, b)) == pytest.approx(expected, abs=1e-6)


# Features of a frame


def test_a_frame_by_hand(look):
    """Upright, facing y, going 2 m/s to its left and turning at 3 rad/s."""
    qpos, qvel = tiny.standing(1)[0], np.zeros(11)
    qpos[:2], qpos[3:7] = [7.0, -3.0], rotation.about_z(jnp.float32(np.pi / 2))
    qvel[0], qvel[5] = -2.0, 3.0
    poses = [np.tile(x, (31, 1)).astype(np.float32) for x in (qpos, qvel)]
    found = np.asarray(look(Motion(*poses, *[jnp.zeros(())] * 3, loop=True)))[0]
    assert found.shape == (16,)
    centers = found[:12].reshape(4, 3)
    np.testing.assert_allclose(centers[0], [0.0, 0.0, 0.5], atol=1e-5)
    np.testing.assert_allclose(centers[1, :2], 0.0, atol=1e-5)  # the torso, above
    assert centers[1, 2] > 0.58
    # The feet reach forward a little, which their centres show; left is at +y.
    np.testing.assert_allclose(centers[2, :2], [0.02 / 3, 0.12], atol=1e-3)
    np.testing.assert_allclose(centers[3, :2], [0.02 / 3, -0.12], atol=1e-3)
    np.testing.assert_allclose(found[12:], [0.0, 2.0, 0.0, 3.0], atol=1e-5)


# Tables of a motion


@pytest.mark.parametrize("roll", [1, 10, 17])
def test_the_style_of_a_cycle_does_not_depend_on_where_it_begins(who, same, encode, look, roll):
    later = _walk(who, roll)
    found = gram.style_of(gram.table(later, look(later), encode, WIDTH), WIDTH)
    assert float(gram.distance(same.target, found)) < 2e-3


def test_another_motion_has_another_style(same, other):
    np.testing.assert_array_equal(same.target, other.target)
    own = [gram.style_of(style.reference, WIDTH) for style in (same, other)]
    assert float(gram.distance(same.target, own[0])) == 0.0
    assert float(gram.distance(same.target, own[1])) > 0.1


def test_a_motion_without_loop_is_seen_from_where_the_encoder_sees_enough(who, encode, look):
    """Ten frames at rest before it begins would count otherwise."""
    motion = tiny.make_motion(who, tiny.walking(), False)
    frames = look(motion)
    found = gram.style_of(gram.table(motion, frames, encode, WIDTH), WIDTH)
    np.testing.assert_allclose(found, gram.matrix(encode(frames)), rtol=1e-4, atol=1e-5)


def test_a_motion_shorter_than_the_encoder_is_refused(who, encode):
    short = tiny.make_motion(who, tiny.walking(4), False, seconds=0.1)
    with pytest.raises(UserError, match="0.10 s without loop is too short .* 4 control frames"):
        gram.table(short, jnp.zeros((4, 16)), encode, WIDTH)


# The window


def test_a_window_that_follows_the_reference_is_the_references(who, walk, same):
    params, tree = kinematics.body_params(who.model), kinematics.tree(who.model)

    @jit
    def followed(phase: jax.Array) -> gram.Window:
        def one(window: gram.Window, phase: jax.Array) -> tuple[gram.Window, None]:
            bodies = kinematics.kinematics(tree, params, *sample(who.layout, walk, phase))
            return gram.push(same, window, params, bodies), None

        return jax.lax.scan(one, gram.fill(same, phase), phase + 1 + jnp.arange(7))[0]

    for phase in (0.0, 12.5, 200.25):
        found, expected = followed(jnp.float32(phase)), gram.fill(same, jnp.float32(phase + 7))
        assert found.frames.shape == (WIDTH, 16) and found.hidden.shape == (30, CHANNELS)
        np.testing.assert_allclose(found.frames, expected.frames, atol=5e-3)
        np.testing.assert_allclose(found.hidden, expected.hidden, atol=3e-2)


def test_a_window_keeps_what_came_before(who, walk, encode):
    """Of 0.2 s, or 6 control steps."""
    style = gram.make(who, walk, walk, encode, WIDTH, look_back=0.2)
    params, tree = kinematics.body_params(who.model), kinematics.tree(who.model)

    @jit
    def both(qpos: jax.Array, qvel: jax.Array) -> tuple[gram.Window, gram.Window]:
        before, bodies = gram.fill(style, jnp.float32(3.0)), kinematics.kinematics
        return before, gram.push(style, before, params, bodies(tree, params, qpos, qvel))

    before, after = both(walk.qpos[9], walk.qvel[9])
    assert before.hidden.shape == (6, CHANNELS)
    np.testing.assert_array_equal(after.hidden[:-1], before.hidden[1:])
    np.testing.assert_array_equal(after.frames[:-1], before.frames[1:])
    np.testing.assert_allclose(after.hidden[-1:], encode(after.frames), rtol=1e-6)


# In the environment


def _puppet(who: Character, pulled: Motion) -> Physics:
    """Returns an engine whose character is pulled along a motion, whatever the controls."""

    def step(model: object, variant: jax.Array, state: SimState, ctrl: jax.Array) -> SimState:
        moved = sample(who.layout, pulled, state.qacc[0] + 1.0)
        return SimState(*moved, state.qacc + 1.0, jnp.bool_(False))

    def init(model: object, variant: jax.Array, qpos: jax.Array, qvel: jax.Array) -> SimState:
        return start(qpos, qvel)

    return Physics(load=lambda models: None, init=init, step=step)


def _env(who: Character, pulled: Motion, reference: Motion, wanted: gram.Style | None):
    kind, clip = ("none", None) if wanted is None else ("gram", "some")
    style = StyleConfig(style=kind, style_clip=clip, gram=ALPHA)
    config = EnvConfig(reward="survival" if wanted is None else "style", style=style)
    wide = BoundsConfig(com=(9.0, 9.0, 9.0), root=9.0, joints=9.0, end_effectors=9.0)
    sizes = bounds.make(who, wide)
    return core.make(
        who, variants.one(who, reference, None), _puppet(who, pulled), sizes, config, wanted
    )


def _rewards(who: Character, pulled: Motion, wanted: gram.Style) -> tuple[np.ndarray, float]:
    """Returns the rewards of two cycles, and how near the last window is to the style."""
    env = _env(who, pulled, pulled, wanted)

    def one(state: core.EnvState, _: None) -> tuple[core.EnvState, jax.Array]:
        state, outcome = env.step(state, jnp.zeros(5))
        return state, outcome.spike

    last, found = jit(lambda: jax.lax.scan(one, env.start(jnp.float32(0.0)), None, 60))()
    return np.asarray(found), float(gram.reward(wanted, last.window, ALPHA))


def test_the_style_clip_earns_more_than_another(who, walk, same, other):
    itself, near = _rewards(who, walk, same)
    different, far = _rewards(who, _bound(who), other)
    for found in (itself, different):
        assert found.shape == (60,) and (found >= 0).all() and (found <= 1).all()
    assert near > 0.95 > 0.8 > far
    assert itself.min() > different.max()


class Running(NamedTuple):
    """An environment of the walk, in which the character hops, and its compiled functions."""

    start: Callable[[jax.Array], core.EnvState]
    place: Callable[[jax.Array, jax.Array, jax.Array], core.EnvState]
    step: Callable[[core.EnvState, jax.Array], tuple[core.EnvState, core.Outcome]]


@pytest.fixture(scope="module")
def hopping(who: Character, walk: Motion, same: gram.Style) -> Running:
    env = _env(who, _bound(who), walk, same)
    return Running(jit(env.start), jit(env.place), jit(env.step))


def test_the_reward_is_that_of_the_window_times_the_regulariser(hopping, same):
    state = hopping.start(jnp.float32(4.0))
    for _ in range(8):
        state, outcome = hopping.step(state, jnp.zeros(5))
    apart = float(gram.distance(same.target, gram.matrix(state.window.hidden)))
    style = float(gram.reward(same, state.window, ALPHA))
    assert apart > 0.02 and style == pytest.approx(np.exp(-apart / ALPHA), rel=1e-5)
    assert 0.5 * style < float(outcome.spike) < style


def test_a_start_resets_the_window(hopping, same):
    fresh = hopping.start(jnp.float32(4.0))
    expected = gram.fill(same, jnp.float32(4.0))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), fresh.window, expected)
    state = fresh
    for _ in range(3):
        state, _ = hopping.step(state, jnp.zeros(5))
    assert not np.allclose(state.window.hidden, fresh.window.hidden, atol=1e-2)
    placed = hopping.place(jnp.float32(4.0), state.sim.qpos, state.sim.qvel)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), placed.window, expected)


def test_a_diverged_window_earns_nothing(hopping):
    state = hopping.start(jnp.float32(0.0))
    broken = dataclasses.replace(
        state,
        sim=dataclasses.replace(state.sim, qacc=jnp.full(11, jnp.nan)),
        window=jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), state.window),
    )
    _, outcome = hopping.step(broken, jnp.zeros(5))
    assert bool(outcome.terminated) and float(outcome.spike) == 0.0


def test_without_a_style_the_state_holds_no_window(who, walk):
    env = _env(who, walk, walk, None)
    state = jax.eval_shape(env.start, jnp.float32(0.0))
    after, _ = jax.eval_shape(env.step, state, jnp.zeros(5))
    assert state.window is None and after.window is None
    # qpos, qvel, engine, diverged; phase, step, variant.
    assert len(jax.tree.leaves(state)) == len(jax.tree.leaves(after)) == 7


def test_gram_needs_a_style_and_nothing_else_takes_one(who, walk, same):
    sizes = bounds.make(who, BoundsConfig())
    gram_config = EnvConfig(reward="style", style=StyleConfig(style="gram", style_clip="some"))
    for config, given in ((gram_config, None), (EnvConfig(), same)):
        with pytest.raises(UserError, match="only gram comes with a style"):
            only = variants.one(who, walk, None)
            core.make(who, only, _puppet(who, walk), sizes, config, given)
