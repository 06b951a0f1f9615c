# SPDX-License-Identifier: Apache-2.0
"""Spacetime bounds: each channel flips at its own size alone; sizes over phase; refusals."""

from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import tiny

from jaxskills import kinematics, pose
from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import bounds
from jaxskills.env.bounds import BoundsConfig
from jaxskills.errors import UserError

NAMES = (
    *("com_x", "com_y", "com_z", "root", "spine", "left_hip", "right_hip"),
    *("torso_position", "left_leg_position", "right_leg_position"),
)


@pytest.fixture(scope="module")
def errors(who: Character) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Returns (pose, reference pose) -> the error of each channel."""
    tree, params = kinematics.tree(who.model), kinematics.body_params(who.model)
    effectors = tuple(who.body(name) for name in who.end_effectors)
    axis, still = jnp.array([1.0, 0.0, 0.0]), jnp.zeros(who.layout.nv)

    def measure(qpos, ref_qpos):
        pair = [kinematics.kinematics(tree, params, q, still) for q in (qpos, ref_qpos)]
        seen = [bounds.heading_effectors(bodies, effectors, axis) for bodies in pair]
        offset = pose.minus(who.layout, ref_qpos, qpos)
        return bounds.errors(who.layout, offset, pair[0], pair[1], (seen[0], seen[1]))

    compiled = jit(measure)
    as_float = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return lambda qpos, ref: np.asarray(compiled(as_float(qpos), as_float(ref)))


def _moved(who: Character, start: np.ndarray, **by_dof: float) -> np.ndarray:
    """Returns the pose with displacements added, given as `d3=0.1`."""
    d = np.zeros(who.layout.nv)
    for name, value in by_dof.items():
        d[int(name[1:])] = value
    qpos = start.copy()
    mujoco.mj_integratePos(who.model, qpos, d, 1.0)
    return qpos


def _sizes(made: bounds.Bounds, phase: float, length: float = 30.0) -> np.ndarray:
    return np.asarray(bounds.sizes(made, jnp.float32(phase % length / length)))


def test_channels_are_in_order(who: Character):
    assert bounds.channel_names(who) == NAMES
    made = bounds.make(who, BoundsConfig())
    assert made.names == NAMES
    expected = [0.3, 0.3, 0.2, 0.7, 0.7, 0.7, 0.7, 0.5, 0.5, 0.5]
    np.testing.assert_allclose(_sizes(made, 3.0), expected, rtol=1e-6)


@pytest.mark.parametrize("frame", [0, 7, 20])
def test_the_reference_is_inside_bounds_of_any_size(who: Character, errors: Callable, frame: int):
    qpos = _moved(who, tiny.walking()[frame], d3=0.4, d4=-0.3, d5=2.0, d7=0.8)
    tight = bounds.make(who, BoundsConfig((1e-6,) * 3, 1e-6, 1e-6, 1e-6))  # of float32
    found = errors(qpos, qpos)
    assert (found <= _sizes(tight, frame)).all(), dict(zip(NAMES, found, strict=True))


# Each moves one channel out of the default bounds first. Degrees of freedom: 0-2 root position,
# 3-5 root rotation, 6-8 spine, 9 and 10 hips.
_ALONE = [
    ("com_x", "d0", 0.3, {}),
    ("com_x", "d0", -0.3, {}),
    ("com_y", "d1", 0.3, {}),
    ("com_z", "d2", 0.2, {}),
    ("com_z", "d2", -0.2, {}),
    ("root", "d5", 0.7, {}),
    ("spine", "d8", 0.7, {}),
    ("spine", "d6", -0.7, {}),
    ("left_hip", "d9", 0.7, {}),
    ("right_hip", "d10", -0.7, {}),
    ("left_leg_position", "d2", 0.1, {"left_leg_position": 0.1}),
    ("torso_position", "d2", -0.15, {"torso_position": 0.15}),
]


@pytest.mark.parametrize(("name", "dof", "edge", "channels"), _ALONE)
def test_one_channel_just_outside_flips_only_itself(
    who: Character, errors: Callable, name: str, dof: str, edge: float, channels: dict
):
    made = bounds.make(who, BoundsConfig(channels=channels))
    start = tiny.standing(1)[0]
    for factor, outside in ((0.999, set()), (1.001, {name})):
        found = errors(_moved(who, start, **{dof: factor * edge}), start)
        too_far = {NAMES[i] for i in np.flatnonzero(found > _sizes(made, 0.0))}
        assert too_far == outside, found


def test_a_ball_joint_counts_its_whole_angle(who: Character, errors: Callable):
    start = tiny.standing(1)[0]
    found = errors(_moved(who, start, d6=0.3, d7=0.4, d8=-1.2), start)
    np.testing.assert_allclose(found[NAMES.index("spine")], 1.3, atol=1e-5)
    # A rotation error does not depend on where the joint is.
    at = _moved(who, start, d6=1.0, d7=-0.5)
    found = errors(_moved(who, at, d6=0.3, d7=0.4, d8=-1.2), at)
    np.testing.assert_allclose(found[NAMES.index("spine")], 1.3, atol=1e-5)


def test_errors_are_monotone_in_the_distance(who: Character, errors: Callable):
    start = tiny.walking()[4]
    shape = np.array([0.1, -0.2, 0.05, 0.1, 0.2, 0.4, 0.3, -0.1, 0.2, 0.3, -0.2])
    rows = [
        errors(_moved(who, start, **{f"d{i}": s * x for i, x in enumerate(shape)}), start)
        for s in np.linspace(0.0, 1.5, 7)
    ]
    assert (np.diff(np.stack(rows), axis=0) > -1e-6).all()
    assert (rows[-1] > 0.01).all()


def test_effectors_do_not_see_a_turn_or_shift_of_everything(who: Character, errors: Callable):
    start = tiny.walking()[4]
    found = errors(_moved(who, start, d0=5.0, d1=-3.0, d5=2.0), start)
    np.testing.assert_allclose(found[7:], 0.0, atol=1e-5)


def test_sizes_are_linear_between_knots_of_phase(who: Character):
    config = BoundsConfig(channels={"root": (1.0, 3.0, 2.0), "com_z": (0.2, 0.4)})
    made = bounds.make(who, config)
    assert made.sizes.shape == (3, 10)
    root, up = NAMES.index("root"), NAMES.index("com_z")
    for phase, expected in ((0.0, 1.0), (7.5, 2.0), (15.0, 3.0), (22.5, 2.5), (37.5, 2.0)):
        np.testing.assert_allclose(_sizes(made, phase)[root], expected, rtol=1e-6)
    for phase, expected in ((0.0, 0.2), (7.5, 0.25), (15.0, 0.3), (29.999, 0.4)):
        np.testing.assert_allclose(_sizes(made, phase)[up], expected, rtol=1e-4)
    np.testing.assert_allclose(_sizes(made, 11.0)[0], 0.3, rtol=1e-6)


def test_knots_in_any_places_are_met(who: Character):
    """0.35 and 1/3 lie on sixtieths of the cycle; the evenly spread one on thirds."""
    config = BoundsConfig(
        channels={
            "com_z": ((0.0, 0.2), (0.35, 0.5), (1.0, 0.2)),
            "root": ((1 / 3, 1.0), (0.75, 0.4)),
            "spine": (0.1, 0.4, 0.1, 0.7),
        }
    )
    made = bounds.make(who, config)
    assert made.sizes.shape == (61, 10)
    place = {name: NAMES.index(name) for name in ("com_x", "com_z", "root", "spine")}
    for share, expected in (
        (0.0, (0.3, 0.2, 1.0, 0.1)),
        (0.175, (0.3, 0.35, 1.0, 0.2575)),
        (0.35, (0.3, 0.5, 0.976, 0.385)),
        (0.75, (0.3, 0.2 + 0.3 * 0.25 / 0.65, 0.4, 0.25)),
        (0.99, (0.3, 0.2 + 0.3 * 0.01 / 0.65, 0.4, 0.682)),
    ):
        found = _sizes(made, 30.0 * share)[list(place.values())]
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_knots_that_no_even_steps_meet_are_met_within_half_a_percent(who: Character):
    made = bounds.make(who, BoundsConfig(channels={"root": ((0.0, 1.0), (0.123456, 2.0))}))
    assert made.sizes.shape == (201, 10)
    root = NAMES.index("root")
    for share in np.linspace(0.0, 0.999, 50):
        expected = np.interp(share, [0.0, 0.123456], [1.0, 2.0])
        # The slope is 1 / 0.123, and a chord between steps of 0.005 is at most a quarter off.
        assert abs(_sizes(made, 30.0 * share)[root] - expected) < 0.005 / 4 / 0.123 + 1e-4


def test_an_infinite_size_is_no_bound_beside_knots_either(who: Character):
    channels = {"com_x": float("inf"), "root": ((0.0, 0.2), (1.0, 0.4))}
    for config in (
        BoundsConfig(channels=channels),
        BoundsConfig(channels={"com_x": float("inf")}),
    ):
        found = _sizes(bounds.make(who, config), 11.0)
        assert np.isfinite(found).all() and found[0] > 1e5 and (found[1:] < 1.0).all()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            BoundsConfig(channels={"spien": 1.0}),
            "unknown bound 'spien': choose one of com_x, com_y",
        ),
        (BoundsConfig(channels={"spine": -0.1}), "bound spine is -0.1: give positive sizes"),
        (BoundsConfig(channels={"spine": 0.0}), "bound spine is 0.0: give positive sizes"),
        (BoundsConfig(channels={"root": (0.1, -1.0)}), "bound root is (0.1, -1.0): give positive"),
        (BoundsConfig(channels={"root": float("nan")}), "bound root is nan: give positive"),
        (BoundsConfig(channels={"root": ()}), "bound root is (): give"),
        (
            BoundsConfig(channels={"root": ((0.5, 0.2), (0.5, 0.3))}),
            "bound root has knots at 0.5, 0.5: give shares of the cycle that rise from 0 to 1",
        ),
        (BoundsConfig(channels={"root": ((0.5, 0.2), (0.4, 0.3))}), "bound root has knots at 0.5"),
        (BoundsConfig(channels={"root": ((0.0, 0.2), (1.1, 0.3))}), "bound root has knots at 0, 1"),
        (BoundsConfig(channels={"root": ((-0.1, 0.2),)}), "bound root has knots at -0.1"),
        (BoundsConfig(channels={"root": ((0.0, 0.2), (1.0, 0.0))}), "bound root is ((0.0, 0.2),"),
        (BoundsConfig(com=(0.3, -0.3, 0.2)), "bound com_y is -0.3: give positive sizes"),
        (BoundsConfig(joints=-1.0), "bound spine is -1.0: give positive sizes"),
        (
            BoundsConfig(no_ground_contact=("head",)),
            "unknown body of walker 'head': choose one of pelvis, torso, left_leg, right_leg",
        ),
    ],
)
def test_what_is_no_bound_is_refused(who: Character, config: BoundsConfig, message: str):
    with pytest.raises(UserError) as raised:
        bounds.make(who, config)
    assert str(raised.value).startswith(message)
    assert "\n" not in str(raised.value)


def test_an_unknown_channel_lists_all_names(who: Character):
    with pytest.raises(UserError) as raised:
        bounds.make(who, BoundsConfig(channels={"neck": 1.0}))
    assert str(raised.value).endswith(", ".join(NAMES))
