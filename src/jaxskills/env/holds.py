# SPDX-License-Identifier: Apache-2.0
"""Hands that hold a bar: close enough to it at the right phase, they are pulled onto it.

FS section 7.1 makes hands stick to a box "when they are close enough to the box within a certain
phase". Here a spring and a damper across the bar, a damper along it, in the engine, are switched on
by one control each. Nothing is remembered: a hand that is pulled further away than its reach has
lost its hold. All numbers are in the model, so films and variants need nothing besides it.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from jaxskills import rotation
from jaxskills.character import Character
from jaxskills.errors import UserError
from jaxskills.kinematics import Bodies

_PREFIX = "hold:"
_AXES = 3  # controls of each hand: across the bar twice, along it
_ALONG = 1  # the axis that the bar lies along


@dataclasses.dataclass(frozen=True)
class Grip:
    """Which hands hold something, and when."""

    hands: tuple[str, ...]  # bodies
    begin: float  # share of the reference from which on they do
    end: float  # share at which they let go
    reach: float = 0.1  # m, nearer than that is close enough
    stiffness: float = 1e4  # N/m: a person of 45 kg hangs 2 cm lower on two hands
    damping: float = 200.0  # N s/m


@struct.dataclass
class Holds:
    """H hands and what each may hold. Arrays, so variants can stack."""

    point: jax.Array  # [H, 3] m, of the hand, in its body
    middle: jax.Array  # [H, 3] m, of the bar
    half: jax.Array  # [H] m, half length of the bar
    phase: jax.Array  # [H, 2] shares of the reference, begin and end
    reach: jax.Array  # [H] m
    body: tuple[int, ...] = struct.field(pytree_node=False)  # [H] index among the N bodies


def validate(grip: Grip, character: Character) -> None:
    """Checks a grip.

    Raises:
      UserError: an unknown body, phases out of order, a number out of range.
    """
    for hand in grip.hands:
        character.body(hand)
    if not (grip.hands and 0.0 <= grip.begin < grip.end <= 1.0):
        raise UserError(
            f"grip of {', '.join(grip.hands) or 'no hand'} from {grip.begin:g} to {grip.end:g}:"
            " name bodies, and shares of the reference in order"
        )
    for name in ("reach", "stiffness", "damping"):
        if not 0.0 < getattr(grip, name) < math.inf:
            raise UserError(f"grip {name} is {getattr(grip, name):g}: give a number above 0")


def add(
    spec: mujoco.MjSpec,
    character: Character,
    grip: Grip,
    name: str,
    middle: np.ndarray,
    length: float,
) -> None:
    """Adds what holds hands at a bar across x.

    Args:
      spec: to change.
      character: whose hands.
      grip: which hands, and when.
      name: of the bar.
      middle: [3] m, of the bar.
      length: m, of the bar.

    Raises:
      UserError: see `validate`.
    """
    validate(grip, character)
    place = spec.worldbody.add_site(name=f"{_PREFIX}{name}", pos=middle, size=[1e-3] * 3, group=4)
    for hand in grip.hands:
        label, body = f"{_PREFIX}{name}_{hand}", spec.body(hand)
        palm = np.array(body.geoms[0].pos) if body.geoms else np.zeros(3)
        body.add_site(name=label, pos=palm, size=[1e-3] * 3, group=4)
        numbers = [character.body(hand), grip.begin, grip.end, grip.reach, length / 2]
        spec.add_numeric(name=label, size=len(numbers), data=numbers)
        for axis in range(_AXES):
            gear = np.zeros(6)
            gear[axis] = 1.0
            pull = spec.add_actuator(
                name=f"{label}_{axis}", target=label, refsite=place.name, gear=gear
            )
            pull.trntype = mujoco.mjtTrn.mjTRN_SITE
            pull.gaintype = mujoco.mjtGain.mjGAIN_AFFINE
            pull.biastype = mujoco.mjtBias.mjBIAS_NONE
            stiffness = 0.0 if axis == _ALONG else grip.stiffness
            pull.gainprm[:3] = 0.0, -stiffness, -grip.damping


def of(model: mujoco.MjModel) -> Holds | None:
    """Returns what hands may hold in a model, None if nothing.

    Its controls, three for each hand, come before the servos'.
    """
    names = [model.numeric(i).name for i in range(model.nnumeric)]
    names = [name for name in names if name.startswith(_PREFIX)]
    if not names:
        return None
    rows = np.stack([model.numeric(name).data for name in names])
    bars = [model.actuator(f"{name}_0").trnid[1] for name in names]
    points = [model.site(name).pos for name in names]
    numbers = (np.stack(points), model.site_pos[bars], rows[:, 4], rows[:, 1:3], rows[:, 3])
    body = tuple(int(index) for index in rows[:, 0])
    return Holds(*(jnp.asarray(x, jnp.float32) for x in numbers), body=body)


def controls(holds: Holds, bodies: Bodies, share: jax.Array) -> jax.Array:
    """Returns the controls `[3 H]`: 1 where a hand holds its bar, else 0.

    Args:
      holds: what is held.
      bodies: where they are.
      share: `[]` phase, as a share of the reference.
    """
    rows = np.array(holds.body, int)
    away = bodies.pos[rows] + rotation.turn(bodies.rot[rows], holds.point) - holds.middle
    along = jnp.abs(away[:, _ALONG])
    across = jnp.linalg.norm(away.at[:, _ALONG].set(0.0), axis=-1)
    near = (across <= holds.reach) & (along <= holds.half)
    now = (holds.phase[:, 0] <= share) & (share <= holds.phase[:, 1])
    return jnp.repeat(jnp.where(near & now, 1.0, 0.0), _AXES)
