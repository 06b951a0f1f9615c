# SPDX-License-Identifier: Apache-2.0
"""Windows of motion for the autoencoder: speeds, mirrors, ends."""

import numpy as np
import pytest
import tiny

from jaxskills.character import Character
from jaxskills.learn import windows


@pytest.fixture(scope="module")
def found(who: Character) -> list[np.ndarray]:
    """Windows of 12 frames: of a walk, of the same turned, and of one without loop."""
    turned = tiny.walking()
    turned[:, :2] = turned[:, 1::-1] * [-1.0, 1.0] + [3.0, 1.0]
    half = np.sqrt(0.5)
    turned[:, 3:7] = [half, 0.0, 0.0, half]
    motions = [
        tiny.make_motion(who, tiny.walking(), True),
        tiny.make_motion(who, turned, True),
        tiny.make_motion(who, tiny.walking(), False),
    ]
    return windows.cut(who, motions, 12, (1.0, 2.0))


def test_one_window_from_each_frame_at_each_speed_and_mirrored(found: list[np.ndarray]):
    assert found[0].shape == (2 * (30 + 30), 12, 16)
    # Without loop the last one begins 11 frames before the end, 22 at double speed.
    assert found[2].shape == (2 * (19 + 8), 12, 16)


def test_where_a_motion_goes_makes_no_difference(found: list[np.ndarray]):
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)


def test_velocities_fit_the_speed(found: list[np.ndarray]):
    """The walk makes half a metre in a second."""
    np.testing.assert_allclose(found[0][:30, :, 12], 0.5, atol=1e-3)
    np.testing.assert_allclose(found[0][30:60, :, 12], 1.0, atol=1e-3)
    # At double speed every second frame is seen.
    np.testing.assert_allclose(found[0][30, :6, :12], found[0][0, ::2, :12], atol=1e-5)


def test_a_loop_goes_on(found: list[np.ndarray]):
    np.testing.assert_allclose(found[0][25, 5:], found[0][0, :7], atol=1e-5)


def test_what_is_too_short_stays_at_its_end(who: Character):
    short = tiny.make_motion(who, tiny.walking(7), False, seconds=0.2)
    only = windows.cut(who, [short], 12, (1.0,))[0]
    assert only.shape == (2, 12, 16)
    np.testing.assert_allclose(only[0, 6:, :12], only[0, 6:7, :12].repeat(6, 0), atol=1e-6)
    assert (only[0, 7:, 12:] == 0.0).all() and (only[0, :5, 12] > 0.1).all()


def test_a_mirrored_walk_is_the_walk_half_a_cycle_later(who: Character, found: list[np.ndarray]):
    straight, mirrored = found[0][:30], found[0][60:90]
    np.testing.assert_allclose(mirrored, np.roll(straight, -15, axis=0), atol=1e-4)
    np.testing.assert_allclose(windows.mirrored(who, mirrored), straight, atol=1e-6)
    assert not np.allclose(mirrored, straight, atol=1e-2)


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("left_knee", "right_knee"),
        ("RightFoot", "LeftFoot"),
        ("l_arm", "r_arm"),
        ("larm", "larm"),
        ("root", "root"),
    ],
)
def test_names_of_twins(name: str, other: str):
    assert windows._twin(name) == other
