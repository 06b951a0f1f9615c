# SPDX-License-Identifier: Apache-2.0
"""Quantities of a performance: what a family of skills is asked for (FS section 4.2).

A *quantity* is a number that a moment has: energy, a height, a speed. A *measure* makes one number
of a performance from it: its value at a phase, its mean or largest value between two phases, how
much it changes, how long it takes. Phases are shares of the reference, 0 to 1.

    energy = measure.at(0.43, measure.kinetic_energy)
    spin = measure.total(measure.turning("root"), 0.2, 0.8)
"""

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills import kinematics
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies, BodyParams


class Moment(NamedTuple):
    """What quantities are read from."""

    body: BodyParams
    bodies: Bodies
    # The whole state, where objects are found; None where there are none.
    qpos: jax.Array | None = None  # [nq]
    qvel: jax.Array | None = None  # [nv]


Read = Callable[[Moment], jax.Array]  # -> []
Quantity = Callable[[Character], Read]  # on the host, where names become indices


class Measure(NamedTuple):
    """One number of a performance."""

    kind: Literal["at", "mean", "largest", "total", "change"]
    quantity: Quantity
    begin: float  # share of the reference
    end: float  # share at which the number is known; `at` has begin equal to end
    # (character, motion) -> the reference's own number, where a motion cannot be measured by itself
    reference: Callable[..., float] | None = None


def at(share: float, quantity: Quantity) -> Measure:
    """Returns the measure of a quantity at one phase."""
    return Measure("at", quantity, share, share)


def mean(quantity: Quantity, begin: float, end: float) -> Measure:
    """Returns the measure of a quantity's mean over the time between two phases."""
    return Measure("mean", quantity, begin, end)


def largest(quantity: Quantity, begin: float, end: float) -> Measure:
    """Returns the measure of the largest value between two phases."""
    return Measure("largest", quantity, begin, end)


def total(quantity: Quantity, begin: float, end: float) -> Measure:
    """Returns the measure of a quantity's integral over the time (s) between two phases."""
    return Measure("total", quantity, begin, end)


def change(quantity: Quantity, begin: float, end: float) -> Measure:
    """Returns the measure of what a quantity is at `end` less what it was at `begin`."""
    return Measure("change", quantity, begin, end)


def duration(begin: float, end: float) -> Measure:
    """Returns the measure of the time (s) between two phases."""
    return total(lambda character: lambda moment: jnp.float32(1.0), begin, end)


def kinetic_energy(character: Character) -> Read:
    """J, of the whole body in the world."""

    def read(moment: Moment) -> jax.Array:
        own = kinematics.kinetic_energy(moment.body, moment.bodies)
        mass = jnp.sum(moment.body.mass)
        return own + 0.5 * mass * jnp.sum(moment.bodies.com_vel**2)

    return read


def com_height(character: Character) -> Read:
    """m, of the centre of mass above the ground."""
    return lambda moment: moment.bodies.com[2]


def height(name: str) -> Quantity:
    """m, of the centre of a body above the ground."""
    return _of_body(name, lambda moment, i: _center(moment, i)[2])


def turning(name: str, axis: Literal["x", "y", "z"] = "z") -> Quantity:
    """rad/s, of a body about an axis of the world; its total is the turn."""
    return _of_body(name, lambda moment, i: moment.bodies.ang[i, "xyz".index(axis)])


def spinning(character: Character) -> Read:
    """rad/s, angular speed of the root, whatever its axis."""
    return lambda moment: jnp.linalg.norm(moment.bodies.ang[0])


def momentum(axis: Literal["x", "y", "z"]) -> Quantity:
    """kg m/s along an axis of the world, of the whole body."""
    i = "xyz".index(axis)
    return lambda character: lambda moment: kinematics.momentum(moment.body, moment.bodies)[0][i]


def angular_momentum(axis: Literal["x", "y", "z"]) -> Quantity:
    """kg m^2/s about the centre of mass along an axis of the world, of the whole body."""
    i = "xyz".index(axis)
    return lambda character: lambda moment: kinematics.momentum(moment.body, moment.bodies)[1][i]


def along(name: str, direction: tuple[float, float, float]) -> Quantity:
    """m, where the centre of a body is along a direction of the world."""
    way = jnp.asarray(direction, jnp.float32)
    return _of_body(name, lambda moment, i: _center(moment, i) @ way)


def com_along(direction: tuple[float, float, float]) -> Quantity:
    """m, where the centre of mass is along a direction of the world."""
    way = jnp.asarray(direction, jnp.float32)
    return lambda character: lambda moment: moment.bodies.com @ way


def bearing(name: str, origin: tuple[float, float], zero: float) -> Quantity:
    """rad, the direction in which the centre of a body lies, seen from above.

    Args:
      name: of the body.
      origin: where it is seen from, x and y in m.
      zero: the direction that counts as 0, rad from x to y.
    """

    def read(moment: Moment, index: int) -> jax.Array:
        away = _center(moment, index)[:2] - jnp.array(origin)
        return jnp.arctan2(away @ jnp.array(_way(zero + math.pi / 2)), away @ jnp.array(_way(zero)))

    return _of_body(name, read)


def ground_height(character: Character) -> Read:
    """m, of the highest of the bodies that are made to touch the ground, the feet."""
    rows = np.array([character.body(name) for name in character.ground])
    return lambda moment: jnp.max(moment.bodies.pos[rows, 2])


def distance(name: str, origin: tuple[float, float]) -> Quantity:
    """m, how far the centre of a body is from a place `origin` (x, y), seen from above."""
    return _of_body(
        name, lambda moment, i: jnp.linalg.norm(_center(moment, i)[:2] - jnp.array(origin))
    )


def _way(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


def _of_body(name: str, read: Callable[[Moment, int], jax.Array]) -> Quantity:
    def quantity(character: Character) -> Read:
        index = character.body(name)
        return lambda moment: read(moment, index)

    return quantity


def _center(moment: Moment, index: int) -> jax.Array:
    turned = moment.bodies.rot[index] @ moment.body.center[index]
    return moment.bodies.pos[index] + turned


# What is known of one measure: [2] numbers, by kind: at (value, -), mean and total (sum, time),
# largest (value, -), change (value at begin, value at end).


def start(measure: Measure) -> jax.Array:
    """Returns what is known of a measure before a performance, `[2]`."""
    return jnp.array([-jnp.inf if measure.kind == "largest" else 0.0, 0.0])


def update(
    measure: Measure,
    known: jax.Array,
    before: jax.Array,
    after: jax.Array,
    share: tuple[jax.Array, jax.Array],
    seconds: float,
) -> jax.Array:
    """Returns what is known `[2]` after a step; the quantity is taken as linear in it.

    Args:
      measure: which.
      known: `[2]` before the step.
      before: `[]` the quantity before the step.
      after: `[]` after it.
      share: phases before and after it, shares of the reference.
      seconds: how long it took.
    """
    first, last = share
    width = jnp.maximum(last - first, 1e-9)
    value_at = lambda s: before + (after - before) * (s - first) / width  # noqa: E731
    passes = lambda s: (first < s) & (s <= last)  # noqa: E731
    low, high = jnp.maximum(first, measure.begin), jnp.minimum(last, measure.end)
    inside = jnp.maximum(high - low, 0.0)
    if measure.kind == "at":
        return known.at[0].set(jnp.where(passes(measure.end), value_at(measure.end), known[0]))
    if measure.kind == "change":
        found = jnp.stack([value_at(measure.begin), value_at(measure.end)])
        return jnp.where(jnp.stack([passes(measure.begin), passes(measure.end)]), found, known)
    if measure.kind == "largest":
        peak = jnp.maximum(value_at(low), value_at(high))
        return known.at[0].set(jnp.where(inside > 0.0, jnp.maximum(known[0], peak), known[0]))
    time = inside / width * seconds
    return known + jnp.stack([0.5 * (value_at(low) + value_at(high)) * time, time])


def value(measure: Measure, known: jax.Array) -> jax.Array:
    """Returns the number `[]`, once the phase has passed the measure's end."""
    if measure.kind == "mean":
        return known[0] / jnp.maximum(known[1], 1e-9)
    return known[1] - known[0] if measure.kind == "change" else known[0]


def validate(name: str, measure: Measure) -> None:
    """Checks the phases of a measure.

    Raises:
      UserError: phases out of order or outside 0 to 1.
    """
    ordered = measure.begin == measure.end if measure.kind == "at" else measure.begin < measure.end
    # What begins at phase 0 would have to be known before the first step.
    least = 0.0 if measure.kind in ("mean", "largest", "total") else 1e-6
    if not (least <= measure.begin and measure.end <= 1.0 and ordered):
        raise UserError(
            f"measure of {name}: phases {measure.begin} to {measure.end}: give shares of the"
            " reference in order, above 0 and up to 1"
        )
