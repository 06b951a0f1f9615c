# SPDX-License-Identifier: Apache-2.0
"""What a style reward changes, measured on episodes and on the reference: before and after.

Apart from the evaluation, so that training does not pay for it. Nothing after a fall counts.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxskills import kinematics, trainer
from jaxskills.compilation import jit
from jaxskills.env import gram
from jaxskills.env.style import hull_volume
from jaxskills.evaluate import Trace
from jaxskills.trainer import Trainer

_MOST_STATES = 4096  # that energy and volume are measured in, evenly chosen
_AT_ONCE = 256
_HULL_NUMBERS = 2**22  # in memory at once while volumes are measured


def style_measures(made: Trainer, trace: Trace, clip: str | None = None) -> dict[str, float | None]:
    """Returns the means over a trace, and of the reference's own motion with `reference_` in front.

    `energy_mean`: J of kinetic energy about the centre of mass. `volume_mean`: m^3 of the hull of
    the bodies. `gram_distance_mean`, if a clip is given or the run has one: how far from its style
    (`gram.distance`, 0 to 1.4), over stretches as long as the reward looks back over; the first
    begins with the episode. None where every episode fell before there was anything to measure.

    Args:
      made: whose trace.
      trace: from `evaluate`.
      clip: name or file of a clip; None: the one whose style the run wanted.

    Raises:
      UserError: a broken clip, or an autoencoder that is missing or of other bodies.
    """
    fallen = np.asarray(trace.fallen)
    standing = ~np.logical_or.accumulate(fallen, axis=0)
    qpos, qvel = (np.asarray(x)[standing] for x in (trace.qpos, trace.qvel))
    chosen = np.linspace(0, len(qpos), min(len(qpos), _MOST_STATES), endpoint=False).astype(int)
    # The last pose of a loop is its first.
    own = slice(None, -1 if made.motion.loop else None)
    reference = np.asarray(made.motion.qpos)[own], np.asarray(made.motion.qvel)[own]
    measured = energy_and_volume(
        made,
        np.concatenate((qpos[chosen], reference[0])),
        np.concatenate((qvel[chosen], reference[1])),
    )
    found: dict[str, float | None] = {}
    for i, name in enumerate(("energy_mean", "volume_mean")):
        found[name] = _mean(measured[: len(chosen), i])
        found[f"reference_{name}"] = _mean(measured[len(chosen) :, i])
    clip = clip or made.config.env.style.style_clip
    if clip is None:
        return found
    style = trainer.style(made.config, made.character, made.motion, clip)
    own_style = gram.style_of(style.reference, style.width)
    found["gram_distance_mean"] = _mean(gram_distances(made, trace, style))
    found["reference_gram_distance_mean"] = float(gram.distance(style.target, own_style))
    return found


def energy_and_volume(made: Trainer, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Returns the energy in J and the volume in m^3 `[M, 2]` of states `[M, nq]` and `[M, nv]`."""
    model = made.character.model
    tree, params = kinematics.tree(model), kinematics.body_params(model)
    count = len(made.character.body_names)
    size = min(_AT_ONCE, max(1, _HULL_NUMBERS // (math.comb(count, 3) * count)))

    def one(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        bodies = kinematics.kinematics(tree, params, qpos, qvel)
        volume = hull_volume(bodies.pos) if count > 3 else jnp.float32(0.0)
        return jnp.stack((kinematics.kinetic_energy(params, bodies), volume))

    at_once = jit(jax.vmap(one))
    # One size, so that it is compiled once.
    rows = [
        np.resize(np.arange(i, min(i + size, len(qpos))), size) for i in range(0, len(qpos), size)
    ]
    found = [np.asarray(at_once(qpos[row], qvel[row])) for row in rows]
    return np.concatenate(found)[: len(qpos)]


def gram_distances(made: Trainer, trace: Trace, style: gram.Style) -> np.ndarray:
    """Returns the distance from a style `[M]` of the M stretches before a fall."""
    width, long = style.width, style.steps

    def measure(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        hidden = style.encode(gram.frames_of(made.character, qpos, qvel))
        stretches = hidden[: len(hidden) // long * long].reshape(-1, long, hidden.shape[-1])
        return jax.vmap(lambda rows: gram.distance(style.target, gram.matrix(rows)))(stretches)

    steps, episodes = np.shape(trace.fallen)
    if steps < width - 1 + long:
        return np.zeros(0)
    found = np.asarray(jit(jax.vmap(measure, 1, 1))(trace.qpos, trace.qvel))  # [S, E]
    return found[_before_fall(np.asarray(trace.fallen), width, long)]


def _before_fall(fallen: np.ndarray, width: int, long: int) -> np.ndarray:
    """Returns which of S stretches of `long` rows end before a fall `[T, E]`: bool `[S, E]`.

    A row sees `width` steps, so the first stretch begins at the first row.
    """
    steps = len(fallen)
    lasted = np.where(fallen.any(0), fallen.argmax(0), steps)
    ends = np.arange(1, (steps - width + 1) // long + 1) * long + width - 1
    return ends[:, None] <= lasted


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values, dtype=float)) if len(values) else None
