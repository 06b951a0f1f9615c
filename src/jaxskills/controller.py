# SPDX-License-Identifier: Apache-2.0
"""A trained family as a character that one plays with: it takes new task parameters at any time.

    pivot = family_controller(*open_run("runs/pivot"))
    step = jax.jit(pivot.step)
    now = pivot.start(pivot.parameters(rotation=1.2))
    now, qpos = step(now)                                   # every 1/30 s
    now = pivot.ask(now, pivot.parameters(rotation=2.0))    # from the next performance on

A performance is one cycle of the motion; the next follows by itself, from where the character
stands. It is simulated where the training was: at the end of each cycle the character is put back
onto the reference, level and about the vertical, which over a level floor changes nothing, and how
far it was moved is kept. So the motion, its task and its objects stay where they are, and `qpos`
is in a world in which the character goes its way. A motion that does not loop is held for half a
second at its end, and begins anew from there, without the character being moved to its first pose.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxskills import families, motion, rotation, variation
from jaxskills.compilation import jit
from jaxskills.env import task as task_lib
from jaxskills.env.core import EnvState
from jaxskills.env.worlds import World
from jaxskills.errors import UserError
from jaxskills.explore import family as family_lib
from jaxskills.explore.family import Asked, Family
from jaxskills.families import Parts
from jaxskills.learn import normalize
from jaxskills.learn.networks import Networks, Params
from jaxskills.learn.normalize import Normalizer
from jaxskills.perform import parts, task_of
from jaxskills.physics import SimState
from jaxskills.trainer import TrainConfig, Trainer, TrainState


@struct.dataclass
class Playing:
    """A character in the middle of a performance."""

    state: EnvState  # where the training was
    asked: Asked  # what this performance is, [1] of each
    following: Asked  # and the next one
    turn: jax.Array  # [] rad about the vertical, from where the training was to the world
    shift: jax.Array  # [3] m, after the turn; level
    performances: jax.Array  # [] int32, how many came before this one
    fallen: jax.Array  # [] bool, something is on the floor that should not be
    world: World  # what conditions ask for


class Controller(NamedTuple):
    """What one can do with a family. All but `start` is pure: jit it, scan it."""

    # Task parameters by name, in the units of their ranges; the reference's own if not named.
    parameters: Callable[..., jax.Array]  # (**values) -> a [P]
    # On the host: (a [P], before = None) -> on the reference, where the character stood before
    start: Callable[..., Playing]
    step: Callable[[Playing], tuple[Playing, jax.Array]]  # a control step -> its pose [nq] then
    # (playing, a [P]) -> with another task for the next performance. Conditions (gravity, sizes of
    # the body) stay as they are: they take a new `start`.
    ask: Callable[[Playing, jax.Array], Playing]
    reference: Callable[[Playing], jax.Array]  # the pose [nq] of the motion m_a at this moment


def family_controller(made: Trainer, state: TrainState) -> Controller:
    """Returns the character of a trained family.

    Raises:
      UserError: the run is of one skill, or something moves beside the character, which is where
        it was left when the next performance begins.
    """
    spec, family = task_of(made), state.family
    if spec.objects:
        raise UserError(f"a family with a {spec.objects[0].name} does not go on by itself")
    assert family is not None
    own, world = parts(made, 1)
    conditions = np.array([p.condition is not None for p in spec.free], bool)
    wish = functools.partial(_asked, own.config, family)
    place = jit(functools.partial(_start, own))
    step = functools.partial(_step, own, made.networks, state.learner.policy, state.normalizer)

    def parameters(**values: float) -> jax.Array:
        lowest = {p.name: p.range[0] for p in spec.free}
        found = task_lib.from_units(spec, lowest | values)
        named = np.array([p.name in values for p in spec.free], bool)
        return jnp.asarray(np.where(named, found, own.task.base), jnp.float32)

    def start(a: jax.Array, before: Playing | None = None) -> Playing:
        a = jnp.asarray(a, jnp.float32)
        began = place(world(np.asarray(a)[None]), wish(a))
        if before is None:
            return began
        stands = _in_world(before, before.state.sim.qpos)
        turn, shift = _matching(began.state.sim.qpos, stands)
        count = before.performances + 1
        return dataclasses.replace(began, turn=turn, shift=shift, performances=count)

    def ask(playing: Playing, a: jax.Array) -> Playing:
        a = jnp.where(conditions, playing.asked.a[0], jnp.asarray(a, jnp.float32))
        return dataclasses.replace(playing, following=wish(a))

    return Controller(parameters, start, step, ask, functools.partial(_reference, own))


def _asked(config: TrainConfig, family: Family, a: jax.Array) -> Asked:
    return family_lib.best(config.family, family, a[None])


def _start(own: Parts, world: World, asked: Asked) -> Playing:
    state = families.environment(own, world, asked).start(jnp.float32(0.0))
    still = jnp.float32(0.0), jnp.zeros(3), jnp.int32(0), jnp.bool_(False)
    return Playing(state, asked, asked, *still, world)


def _step(
    own: Parts, nets: Networks, policy: Params, normalizer: Normalizer, playing: Playing
) -> tuple[Playing, jax.Array]:
    env = families.environment(own, playing.world, playing.asked)
    seen = normalize.apply(normalizer, env.observe(playing.state))
    state, outcome = env.step(playing.state, nets.mean(policy, seen))
    fallen = outcome.report.fallen | state.sim.diverged
    playing = dataclasses.replace(playing, state=state, fallen=fallen)
    end = env.length if own.shown.loop else env.end
    onward = _onward(own, state.phase - end, playing)
    over = state.phase >= end
    playing = jax.tree.map(lambda new, old: jnp.where(over, new, old), onward, playing)
    return playing, _in_world(playing, playing.state.sim.qpos)


def _onward(own: Parts, phase: jax.Array, playing: Playing) -> Playing:
    """Returns the next performance at `phase`, the character put back onto its reference."""
    state = playing.state
    target = _shown(own, playing.world, playing.following, phase)
    back, away = _matching(state.sim.qpos, target)
    sim, known = _moved(state.sim, back, away), own.task.start()
    # What brings it back has to be undone first on the way to the world.
    turn = playing.turn - back
    return dataclasses.replace(
        playing,
        state=dataclasses.replace(state, sim=sim, phase=phase, step=jnp.int32(0), known=known),
        asked=playing.following,
        turn=turn,
        shift=playing.shift - rotation.rotate(rotation.about_z(turn), away),
        performances=playing.performances + 1,
    )


def _reference(own: Parts, playing: Playing) -> jax.Array:
    shown = _shown(own, playing.world, playing.asked, playing.state.phase)
    return _in_world(playing, shown)


def _shown(own: Parts, world: World, asked: Asked, phase: jax.Array) -> jax.Array:
    """Returns the pose `[nq]` of the motion m_a."""
    layout = own.character.layout
    made = variation.unflatten(asked.x[0], layout.own.nv)
    shown = variation.displace(layout, jax.tree.map(lambda x: x[0], world.motion), made)
    return motion.sample(layout, shown, phase)[0]


def _matching(qpos: jax.Array, target: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the turn `[]` and then the level shift `[3]` that bring one root onto another.

    As `trace.align` does.
    """
    apart = rotation.mul(target[3:7], rotation.inv(qpos[3:7]))
    turn = 2.0 * jnp.arctan2(apart[3], apart[0])
    level = jnp.array([1.0, 1.0, 0.0])
    return turn, level * (target[:3] - rotation.rotate(rotation.about_z(turn), qpos[:3]))


def _moved(sim: SimState, turn: jax.Array, shift: jax.Array) -> SimState:
    """Returns the simulation turned about the vertical and shifted, all else as it was."""
    about = rotation.about_z(turn)
    pos = rotation.rotate(about, sim.qpos[:3]) + shift
    qpos = jnp.concatenate((pos, rotation.mul(about, sim.qpos[3:7]), sim.qpos[7:]))
    # The root's linear velocity is in the world, its angular one in its own frame.
    first = lambda v: jnp.concatenate((rotation.rotate(about, v[:3]), v[3:]))  # noqa: E731
    return dataclasses.replace(sim, qpos=qpos, qvel=first(sim.qvel), qacc=first(sim.qacc))


def _in_world(playing: Playing, qpos: jax.Array) -> jax.Array:
    about = rotation.about_z(playing.turn)
    pos = rotation.rotate(about, qpos[:3]) + playing.shift
    return jnp.concatenate((pos, rotation.mul(about, qpos[3:7]), qpos[7:]))
