# SPDX-License-Identifier: Apache-2.0
"""The environment of a family: variants of the reference, warped time, tracking and a task."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from jaxskills import motion, variation
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds, core, measure, task, variants
from jaxskills.env.bounds import BoundsConfig
from jaxskills.env.core import EnvConfig, Environment
from jaxskills.env.task import Parameter, TaskSpec
from jaxskills.motion import Motion
from jaxskills.variation import Variation

HEIGHT = Parameter("height", (0.5, 1.5), measure=measure.at(0.5, measure.com_height), sigma=0.2)
WIDE = BoundsConfig(com=(9.0, 9.0, 9.0), root=9.0, joints=9.0, end_effectors=9.0)
TRACKING = EnvConfig(reward="tracking", time_warp=True)


@pytest.fixture(scope="module")
def who(tmp_path_factory: pytest.TempPathFactory) -> Character:
    return tiny.load_character(tmp_path_factory.mktemp("who"))


@pytest.fixture(scope="module")
def stand(who: Character) -> Motion:
    """A stand of one second, high above the floor, that does not loop."""
    qpos = tiny.standing(31)
    qpos[:, 2] += 1.0
    return tiny.make_motion(who, qpos, False)


def _raised(who: Character, stand: Motion, height: float, tau: float) -> Variation:
    itself = variation.zeros(4, who.layout.nv)
    return Variation(itself.d.at[:, 2].set(height), itself.tau + tau)


def _family(who: Character, stand: Motion, config: EnvConfig, asked: bool = True) -> Environment:
    """Returns two variants, the second 0.3 m higher and faster; nothing ever moves in them."""
    rows = []
    for height, tau, a in ((0.0, 0.0, 0.5), (0.3, 0.2, 0.75)):
        made = _raised(who, stand, height, tau)
        shown = variation.displace(who.layout, stand, made)
        rows.append(variants.row(who, shown, made, jnp.array([a])))
    asks = task.make(TaskSpec((HEIGHT,)), who, stand) if asked else None
    both = variants.stack(rows, None)
    return core.make(who, both, tiny.stopped(), bounds.make(who, WIDE), config, task=asks)


@pytest.fixture(scope="module")
def family(who: Character, stand: Motion) -> Environment:
    made = _family(who, stand, TRACKING)
    return made._replace(start=jit(made.start), step=jit(made.step), observe=jit(made.observe))


STILL = jnp.zeros(6)


def test_each_environment_has_its_own_reference(family: Environment):
    low, high = (family.start(jnp.float32(3.0), jnp.int32(i)) for i in range(2))
    assert float(high.sim.qpos[2] - low.sim.qpos[2]) == pytest.approx(0.3, abs=1e-5)
    assert (int(low.variant), int(high.variant)) == (0, 1)


def test_where_an_episode_begins_can_be_given(who: Character):
    walk = tiny.make_motion(who, tiny.walking(), True)
    itself = variation.zeros(4, who.layout.nv)
    plain = variants.row(who, walk, itself, jnp.zeros(0))
    first = motion.sample(who.layout, walk, 9.0)
    given = dataclasses.replace(plain, first=first)
    for phase, row, shown in ((0.0, plain, 0.0), (0.0, given, 9.0), (4.0, given, 4.0)):
        there = variants.begin(who.layout, row, jnp.float32(phase))
        for value, expected in zip(there, motion.sample(who.layout, walk, shown), strict=True):
            np.testing.assert_allclose(value, expected, atol=1e-6)


def test_the_policy_chooses_how_fast_phase_goes_by(family: Environment):
    assert family.action_size == 6
    for variant, push, expected in (
        (0, 0.0, 0.0),
        (0, 0.2, 0.3),
        (1, 0.0, 0.2),
        (1, 0.2, 0.5),
        (1, 5.0, 1.0),  # the limits are those of the speed itself
        (1, -5.0, -2.0),
    ):
        state = family.start(jnp.float32(3.0), jnp.int32(variant))
        after, outcome = family.step(state, STILL.at[5].set(push))
        assert float(outcome.dphase) == pytest.approx(np.exp(expected), rel=1e-5)
        assert float(after.phase) == pytest.approx(3.0 + float(outcome.dphase), rel=1e-5)


def test_nobody_hurries_through_the_hold_after_the_end(family: Environment):
    for phase, dphase in ((29.9, np.exp(1.0)), (30.1, 1.0)):
        state = family.start(jnp.float32(phase), jnp.int32(1))
        after, outcome = family.step(state, STILL.at[5].set(5.0))
        assert float(outcome.dphase) == pytest.approx(dphase, rel=1e-5)
        assert float(after.phase) == pytest.approx(phase + dphase, rel=1e-5)
    assert float(family.observe(after)[-3]) == 0.0  # log of the speed


def test_how_long_the_last_pose_is_held(who: Character, stand: Motion):
    for hold in (3.0, 9.0):
        env = _family(who, stand, dataclasses.replace(TRACKING, hold=hold))
        assert env.end == 30.0 + hold
        for phase, over in ((29.9 + hold - 1.0, False), (30.1 + hold - 1.0, True)):
            _, outcome = jit(env.step)(env.start(jnp.float32(phase)), STILL)
            assert bool(outcome.truncated) == over and not bool(outcome.terminated)


def test_tracking_pays_one_a_frame_on_the_reference(family: Environment):
    for variant in range(2):
        state = family.start(jnp.float32(3.0), jnp.int32(variant))
        _, outcome = family.step(state, STILL)
        assert float(outcome.rate) == pytest.approx(1.0, abs=1e-4)
        assert float(outcome.spike) == 0.0
    hasty = family.step(state, STILL.at[5].set(0.1))[1]
    wrong = np.exp(0.2) * (np.exp(0.15) - 1.0)
    expected = 0.84 + 0.16 * np.exp(-((wrong / 0.1) ** 2))
    assert float(hasty.rate) == pytest.approx(expected, abs=1e-4)


def test_the_task_is_paid_when_it_is_known(who: Character, family: Environment):
    """The second variant asks for 1.25 times the height and stands 0.3 m higher."""
    own = tiny.standing()[0][2] + 1.0 - 0.5 + 0.43125
    for variant, factor, wanted in ((0, 1.0, 1.0), (1, (own + 0.3) / own, 1.25)):
        state, paid = family.start(jnp.float32(0.0), jnp.int32(variant)), []
        while float(state.phase) < 25.0:
            state, outcome = family.step(state, STILL)
            paid.append((float(state.phase), float(outcome.spike)))
        spikes = [(phase, spike) for phase, spike in paid if spike]
        assert len(spikes) == 1 and 15.0 <= spikes[0][0] < 16.3
        off = ((factor - wanted) / 0.2) ** 2
        expected = 5.0 * np.exp(-off) + 5.0 * np.exp(-off / 9)
        assert spikes[0][1] == pytest.approx(expected, rel=0.02)


def test_the_policy_sees_task_and_speed(who: Character, stand: Motion, family: Environment):
    plain = _family(who, stand, EnvConfig(), asked=False)
    state = family.start(jnp.float32(3.0), jnp.int32(1))
    seen, less = family.observe(state), plain.observe(plain.start(jnp.float32(3.0), jnp.int32(1)))
    np.testing.assert_allclose(seen[: len(less)], less, atol=1e-5)
    np.testing.assert_allclose(seen[len(less) :], [0.2, 0.75, 0.0], atol=1e-5)


def test_without_time_warp_phase_goes_by_evenly(who: Character, stand: Motion):
    made = _family(who, stand, EnvConfig(reward="tracking"))
    assert made.action_size == 5
    _, outcome = jax.jit(made.step)(made.start(jnp.float32(3.0), jnp.int32(1)), jnp.zeros(5))
    assert float(outcome.dphase) == 1.0


def test_the_target_is_ahead_by_the_chosen_speed(who: Character):
    """On a walk, a hasty step pulls towards where the reference is later."""
    walk = tiny.make_motion(who, tiny.walking(), True)
    engine, model = tiny.make_physics(who)
    sizes = bounds.make(who, WIDE)
    env = core.make(who, variants.one(who, walk, model), engine, sizes, TRACKING)
    state = env.start(jnp.float32(4.0))
    reached = []
    for push in (-0.5, 0.0, 0.5):
        after, outcome = jit(env.step)(state, STILL.at[5].set(push))
        target = motion.sample(who.layout, walk, 4.0 + outcome.dphase)[0]
        reached.append((float(target[11]), float(after.sim.qpos[11])))
    (near, a), (_, b), (far, c) = reached
    assert (far - near) * (c - a) > 0.0 and min(a, c) < b < max(a, c)


def test_another_motion_can_be_fed_forward(who: Character):
    """Bent by 0.1 rad and faster, it moves servos as that action does on the reference."""
    walk = tiny.make_motion(who, tiny.walking(), True)
    engine, model = tiny.make_physics(who)
    itself = variation.zeros(4, who.layout.nv)
    made = Variation(itself.d.at[:, 9].set(0.1), itself.tau + 0.3)
    walk = variation.displace(who.layout, walk, itself)  # with velocities from the poses
    plain = variants.row(who, walk, itself, jnp.zeros(0))
    ahead = variants.Fed(variation.displace(who.layout, walk, made), made)
    found = []
    for row, action in (
        (plain, STILL.at[3].set(0.1).at[5].set(0.2)),  # of 1.5: `EnvConfig.warp_scale`
        (dataclasses.replace(plain, fed=ahead), STILL),
        (plain, STILL),
    ):
        only = variants.stack([row], model)
        env = core.make(who, only, engine, bounds.make(who, WIDE), TRACKING)
        start = env.start(jnp.float32(4.0))
        shown = motion.sample(who.layout, walk, 4.0)[0]  # but for the height: soles off the floor
        np.testing.assert_array_equal(start.sim.qpos[3:], shown[3:])
        after, outcome = jit(env.step)(start, action)
        found.append((after.sim.qpos, after.phase, outcome.rate, outcome.obs))
    for acted, fed, still in zip(*found, strict=True):
        np.testing.assert_allclose(acted, fed, atol=1e-4)
        assert np.abs(fed - still).max() > 1e-3
