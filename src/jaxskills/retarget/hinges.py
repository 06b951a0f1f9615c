# SPDX-License-Identifier: Apache-2.0
"""A rotation written as the angles of one, two or three hinges that follow each other.

`R = rot(a1, t1) rot(a2, t2) rot(a3, t3)` is solved by where it takes `a3` (Paden-Kahan subproblem
2): exact whenever a solution exists, which it always does for orthogonal axes. Each frame has two
solutions; the run through the frames that stays continuous, and inside the ranges, is taken.
"""

import numpy as np
from scipy.spatial.transform import Rotation

_TURN = 2.0 * np.pi


def angles(rotation: Rotation, axes: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Returns the hinge angles [F,n] in rad, continuous along the frames.

    Args:
      rotation: F rotations.
      axes: [n,3] hinge axes at zero angles, outermost first, n = 1, 2 or 3; no two neighbours may
        be parallel.
      middles: [n] rad, middle of each hinge's range: whole turns are chosen to lie near it.
    """
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    if len(axes) == 1:
        return _near(np.unwrap(twist(rotation, axes[0]))[:, None], middles)
    third = axes[2] if len(axes) == 3 else _unit(np.cross(axes[0], axes[1]))
    both = np.stack(_solutions(rotation, axes[0], axes[1], third))[..., : len(axes)]  # [2,F,n]
    runs = [_near(_follow(both, start), middles) for start in (0, 1)]
    return min(runs, key=lambda run: float(np.abs(run - middles).sum()))


def twist(rotation: Rotation, axis: np.ndarray) -> np.ndarray:
    """Returns the turn [F] in rad about a unit `axis`, in (-pi, pi] (swing-twist)."""
    quat = rotation.as_quat(scalar_first=True)
    half = np.arctan2(quat[:, 1:] @ axis, quat[:, 0])
    return (2.0 * half + np.pi) % _TURN - np.pi


def compose(values: np.ndarray, axes: np.ndarray) -> Rotation:
    """Returns the F rotations that hinges with angles [F,n] make."""
    product = Rotation.identity(len(values))
    for index, axis in enumerate(axes):
        product = product * Rotation.from_rotvec(values[:, index, None] * _unit(axis))
    return product


def _solutions(
    rotation: Rotation, first: np.ndarray, second: np.ndarray, third: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns both triples of angles, each [F,3]."""
    # Find z with z = rot(second, t2) third and rot(first, t1) z = R third =: goal: z has known
    # components along both axes, so z = (p first + q second) +- r (first x second).
    goal = rotation.apply(third)
    along, with_second, with_third = first @ second, goal @ first, float(third @ second)
    p = (with_second - along * with_third) / (1.0 - along**2)
    q = (with_third - along * with_second) / (1.0 - along**2)
    normal = np.cross(first, second)
    rest = 1.0 - p**2 - q**2 - 2.0 * p * q * along
    r = np.sqrt(np.maximum(rest, 0.0)) / np.linalg.norm(normal)
    flat = p[:, None] * first + q[:, None] * second
    found = []
    for sign in (1.0, -1.0):
        z = flat + sign * r[:, None] * normal
        t1 = _angle_about(first, z, goal)
        t2 = _angle_about(second, np.broadcast_to(third, z.shape), z)
        inner = compose(np.stack([t1, t2], axis=1), np.stack([first, second])).inv() * rotation
        found.append(np.stack([t1, t2, twist(inner, third)], axis=1))
    return found[0], found[1]


def _follow(both: np.ndarray, start: int) -> np.ndarray:
    """Returns the run [F,n] that begins with solution `start` and moves least at each frame."""
    run = [both[start, 0]]
    for options in both[:, 1:].swapaxes(0, 1):
        near = options + _TURN * np.round((run[-1] - options) / _TURN)
        run.append(near[int(np.argmin(np.abs(near - run[-1]).sum(axis=1)))])
    return np.array(run)


def _near(run: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Returns the run with whole turns taken off so that its mean lies near the range's middle."""
    return run - _TURN * np.round((run.mean(axis=0) - middles) / _TURN)


def _angle_about(axis: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the angle [F] that turns `a` onto `b` about `axis`, seen along it."""
    a, b = a - (a @ axis)[:, None] * axis, b - (b @ axis)[:, None] * axis
    return np.arctan2(np.cross(a, b) @ axis, np.sum(a * b, axis=1))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
