# SPDX-License-Identifier: Apache-2.0
"""Tasks: the parameters of a family of skills, a short value that a user writes (FS section 4.2).

    JUMP = TaskSpec(
        parameters=(
            Parameter("gravity", (0.2, 1.65), condition=conditions.gravity),
            Parameter("energy", (0.8, 1.8), measure=measure.at(0.43, measure.kinetic_energy)),
        )
    )

A parameter is measured in the performance, which the task reward asks for, or a condition that is
set before it, or both: where a box stands, and how far the jump onto it went. Ranges are in
multiples of the reference. Learning sees parameters *normalised*: 0 at the lower end of the range,
1 at the upper. A range of no width is a constraint: it is asked for too, but is no parameter.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jaxskills import character as character_lib
from jaxskills import kinematics
from jaxskills.character import Character, Object
from jaxskills.compilation import jit
from jaxskills.env import measure as measure_lib
from jaxskills.env.measure import Measure, Moment
from jaxskills.errors import UserError, unknown
from jaxskills.motion import CONTROL_DT, Motion, sample

# Changes the model of a character on the host: (spec, character, factor).
Condition = Callable[[mujoco.MjSpec, Character, float], None]

_FINEST = 4  # steps in a control frame when the reference is measured


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One task parameter, or a constraint if its range has no width."""

    name: str
    range: tuple[float, float]  # lower and upper end
    measure: Measure | None = None
    condition: Condition | None = None
    relative: bool = True  # the range is in multiples of the reference's own value; else absolute
    sigma: float = 0.1  # of the task reward (FS eq. 8), in units of the range
    continuous: bool = False  # the quantity is asked for all the way, not its measure at the end
    # Of a constraint: a performance that misses it by more than its sigma does not count.
    strict: bool = False

    @property
    def fixed(self) -> bool:
        """Whether it is a constraint."""
        return self.range[0] == self.range[1]


@dataclasses.dataclass(frozen=True)
class TaskSpec:
    """What a family of skills varies in."""

    parameters: tuple[Parameter, ...] = ()
    scenery: tuple[Condition, ...] = ()  # what stands around, whatever the parameters; factor 1
    objects: tuple[Object, ...] = ()  # what moves beside the character, see `objects.add`
    spike_weight: float = 10.0  # w_task of FS section 4.2 for spike rewards
    continuous_weight: float = 0.1  # and for continuous ones
    # Half of the task reward is so many sigmas wide: eq. 8 alone is flat far from what is asked
    # for, or gives little for the last bit. 1 is eq. 8 itself.
    reach: float = 3.0

    @property
    def free(self) -> tuple[Parameter, ...]:
        """The P parameters, without constraints."""
        return tuple(p for p in self.parameters if not p.fixed)

    @property
    def measured(self) -> tuple[Parameter, ...]:
        """The M parameters and constraints that are measured."""
        return tuple(p for p in self.parameters if p.measure is not None)


class Task(NamedTuple):
    """Pure functions of one performance."""

    start: Callable[[], jax.Array]  # () -> known [M, 2]
    # (known, before, after, shares (2), a [P]) -> known, rate [], spike []
    step: Callable[..., tuple[jax.Array, jax.Array, jax.Array]]
    # (known, a [P]) -> [P + M] what the policy sees
    observe: Callable[[jax.Array, jax.Array], jax.Array]
    # (known, a [P]) -> the parameter that was met [P], how well constraints were [] in 0 to 1;
    # 0 without any
    hindsight: Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
    kept: Callable[[jax.Array], jax.Array]  # (known) -> [] bool, whether strict constraints are met
    reference: jax.Array  # [M] what the reference measures
    base: np.ndarray  # [P] normalised parameter of the reference
    begin: float  # share of the reference before which nothing is measured
    end: float  # share of the reference by which everything is known
    tracking_weight: float  # w_tracking of FS section 4.2


def make(spec: TaskSpec, character: Character, motion: Motion) -> Task:
    """Returns the task of a specification, for a character and its reference.

    Raises:
      UserError: a broken specification, or a quantity that the reference has nothing of.
    """
    validate(spec)
    measured, free = spec.measured, spec.free
    measures = [_measure(p) for p in measured]
    reads = [m.quantity(character) for m in measures]
    own = reference_values(spec, character, motion)
    for parameter, value in zip(measured, own, strict=True):
        if parameter.relative and abs(value) < 1e-6:
            raise UserError(
                f"parameter {parameter.name}: the reference measures {value:.2g}, of which there"
                " are no multiples: give an absolute range with relative=False"
            )
    unit = jnp.array([v if p.relative else 1.0 for p, v in zip(measured, own, strict=True)])
    low, width = (jnp.array([f(p.range) for p in measured]) for f in (lambda r: r[0], _width))
    sigma = jnp.array([p.sigma for p in measured])
    place = np.array([free.index(p) if p in free else 0 for p in measured], int)
    fixed = np.array([p.fixed for p in measured], bool)
    steady = np.array([p.continuous for p in measured], bool)
    at_end = [i for i, p in enumerate(measured) if not p.continuous]
    begin = min((measures[i].begin for i in at_end), default=1.0)
    end = max((measures[i].end for i in at_end), default=1.0)
    wanted = lambda a: low + width * a[place] if len(free) else low  # noqa: E731

    def values(known: jax.Array) -> jax.Array:
        rows = [measure_lib.value(m, known[i]) for i, m in enumerate(measures)]
        return jnp.stack(rows) / unit if rows else jnp.zeros(0)

    def start() -> jax.Array:
        rows = [measure_lib.start(m) for m in measures]
        return jnp.stack(rows) if rows else jnp.zeros((0, 2))

    def step(
        known: jax.Array, before: Moment, after: Moment, shares: tuple[jax.Array, jax.Array], a
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        if not measures:
            return known, jnp.float32(0.0), jnp.float32(0.0)
        now = jnp.stack([read(after) for read in reads])
        then = jnp.stack([read(before) for read in reads])
        rows = [
            measure_lib.update(m, known[i], then[i], now[i], shares, CONTROL_DT)
            for i, m in enumerate(measures)
        ]
        known = jnp.stack(rows)
        off = ((values(known) - wanted(a)) / sigma) ** 2
        passed = (shares[0] < end) & (end <= shares[1])
        reward = _closeness(jnp.sum(jnp.where(steady, 0.0, off)), spec.reach)
        spike = jnp.where(passed & bool(at_end), spec.spike_weight * reward, 0.0)
        during = jnp.array([m.begin for m in measures]) <= shares[1]
        during &= shares[1] <= jnp.array([m.end for m in measures])
        apart = ((now / unit - wanted(a)) / sigma) ** 2
        tracked = _closeness(apart, spec.reach) * during * steady
        rate = spec.continuous_weight * jnp.sum(tracked) / max(int(steady.sum()), 1)
        return known, rate, spike

    def observe(known: jax.Array, a: jax.Array) -> jax.Array:
        now = values(known)
        return jnp.concatenate((a, jnp.clip(jnp.where(jnp.isfinite(now), now, 0.0), -10.0, 10.0)))

    def hindsight(known: jax.Array, a: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = values(known)
        for i, parameter in enumerate(measured):
            if not parameter.fixed:
                a = a.at[place[i]].set((found[i] - low[i]) / width[i])
        off = jnp.where(fixed, ((found - low) / sigma) ** 2, 0.0)
        return a, jnp.exp(-jnp.sum(off)) if fixed.any() else jnp.float32(0.0)

    strict = np.array([p.strict for p in measured], bool)

    def kept(known: jax.Array) -> jax.Array:
        return jnp.all(~strict | (jnp.abs(values(known) - low) <= sigma))

    base = np.array([normalised(p, _own(p, measured, own)) for p in free])
    weight = 1.0 - spec.continuous_weight if steady.any() else 1.0
    own = jnp.asarray(own, jnp.float32)
    return Task(start, step, observe, hindsight, kept, own, base, begin, end, weight)


def _closeness(off: jax.Array, reach: float) -> jax.Array:
    """Returns 0 to 1, of a squared distance in sigmas (FS eq. 8, and half of it wider)."""
    return 0.5 * (jnp.exp(-off) + jnp.exp(-off / reach**2))


def placed(spec: TaskSpec, character: Character) -> Character:
    """Returns the character among the scenery of a task."""
    return character_lib.placed(character, scenery(spec, character))


def scenery(spec: TaskSpec, character: Character) -> list[Callable[[mujoco.MjSpec], None]]:
    """Returns what puts a task's scenery into the spec of a character."""
    return [_applied(one, character, 1.0) for one in spec.scenery]


def variant(
    spec: TaskSpec,
    character: Character,
    a: np.ndarray,
    timestep: float = character_lib.DEFAULT_TIMESTEP,
) -> Character:
    """Returns the character under the conditions of a task parameter, to simulate or film it.

    Args:
      spec: of the task.
      character: with what stands and moves around it.
      a: `[P]` the task parameter, normalised.
      timestep: s, of its model.
    """
    pairs = zip(spec.free, np.asarray(a), strict=True)
    changes = [
        _applied(p.condition, character, float(p.range[0] + _width(p.range) * value))
        for p, value in pairs
        if p.condition is not None
    ]
    return character_lib.placed(character, changes, timestep)


def _applied(
    condition: Condition, character: Character, factor: float
) -> Callable[[mujoco.MjSpec], None]:
    return lambda spec: condition(spec, character, factor)


def reference_values(spec: TaskSpec, character: Character, motion: Motion) -> np.ndarray:
    """Returns what the reference itself measures `[M]`, played at its own speed."""
    tree = kinematics.tree(character.model)
    params = kinematics.body_params(character.model)
    length, layout = float(motion.length), character.layout
    shares = np.linspace(0.0, 1.0, max(2, math.ceil(length * _FINEST) + 1))

    def look(share: jax.Array) -> Moment:
        # Just before the end: a motion that does not loop is at rest at its end.
        phase = jnp.minimum(share, 1.0 - 1e-6) * motion.length
        state = sample(layout, motion, phase)
        return Moment(params, kinematics.kinematics(tree, params, *state), *state)

    seconds = length * CONTROL_DT / (len(shares) - 1)
    at = jnp.asarray(shares, jnp.float32)
    made = [_measure(parameter) for parameter in spec.measured]
    own = {i: one.reference(character, motion) for i, one in enumerate(made) if one.reference}

    @jit
    def values() -> list[jax.Array]:
        moments = jax.vmap(look)(at)
        courses = [jax.vmap(one.quantity(character))(moments) for one in made]
        return [_along(one, seconds, of, at) for one, of in zip(made, courses, strict=True)]

    return np.array([own.get(i, float(value)) for i, value in enumerate(values())], float)


def _along(made: Measure, seconds: float, course: jax.Array, shares: jax.Array) -> jax.Array:
    """Returns what a measure `[]` makes of a quantity's `course [S]` at `shares [S]`."""

    def step(known: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        before, after, first, last = row
        return measure_lib.update(made, known, before, after, (first, last), seconds), None

    rows = course[:-1], course[1:], shares[:-1], shares[1:]
    return measure_lib.value(made, jax.lax.scan(step, measure_lib.start(made), rows)[0])


def normalised(parameter: Parameter, value: float) -> float:
    """Returns a value, in units of the range, as a share of the range."""
    return (value - parameter.range[0]) / _width(parameter.range)


def in_units(spec: TaskSpec, a: np.ndarray) -> dict[str, float]:
    """Returns normalised parameters `[P]` by name, in units of their ranges."""
    pairs = zip(spec.free, np.asarray(a), strict=True)
    return {p.name: float(p.range[0] + _width(p.range) * value) for p, value in pairs}


def from_units(spec: TaskSpec, values: dict[str, float]) -> np.ndarray:
    """Returns the normalised parameters `[P]` of values by name.

    Raises:
      UserError: an unknown or missing name, or a value outside its range.
    """
    names = [p.name for p in spec.free]
    for name in values:
        if name not in names:
            raise unknown("task parameter", name, names)
    found = []
    for parameter in spec.free:
        if parameter.name not in values:
            raise UserError(f"task parameter {parameter.name} is missing: give it a value")
        value, (low, high) = values[parameter.name], parameter.range
        if not low <= value <= high:
            raise UserError(f"task parameter {parameter.name} is {value}: give {low} to {high}")
        found.append(normalised(parameter, value))
    return np.array(found)


def validate(spec: TaskSpec) -> None:
    """Checks a specification.

    Raises:
      UserError: a name twice, a range out of order, neither measure nor condition, a constraint
        with a condition, a sigma or a reach out of range.
    """
    names = [p.name for p in spec.parameters]
    if not 1 <= spec.reach < math.inf:
        raise UserError(f"task: reach {spec.reach}: give 1 or more")
    for p in spec.parameters:
        if names.count(p.name) > 1:
            raise UserError(f"task parameter {p.name} comes twice: give each its own name")
        if not (all(map(math.isfinite, p.range)) and p.range[0] <= p.range[1]):
            raise UserError(f"task parameter {p.name}: range {p.range}: give two numbers in order")
        if p.measure is None and p.condition is None:
            raise UserError(f"task parameter {p.name}: give a measure, a condition, or both")
        if p.strict and not p.fixed:
            raise UserError(f"task parameter {p.name}: strict is for a range of no width")
        if p.fixed and (p.measure is None or p.condition is not None):
            raise UserError(
                f"task parameter {p.name}: a range of no width needs a measure, and no condition"
            )
        if not p.sigma > 0:
            raise UserError(f"task parameter {p.name}: sigma {p.sigma}: give a positive number")
        if p.measure is not None:
            measure_lib.validate(p.name, p.measure)


def _measure(parameter: Parameter) -> Measure:
    if parameter.measure is None:
        raise UserError(f"task parameter {parameter.name} is not measured")
    return parameter.measure


def _width(ends: tuple[float, float]) -> float:
    return ends[1] - ends[0]


def _own(parameter: Parameter, measured: tuple[Parameter, ...], values: np.ndarray) -> float:
    """Returns the reference's own place in a range: 1 of its multiples, or what it measures."""
    if parameter.relative:
        return 1.0
    return float(values[measured.index(parameter)]) if parameter in measured else 0.0
