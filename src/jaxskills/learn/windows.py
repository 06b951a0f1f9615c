# SPDX-License-Identifier: Apache-2.0
"""Windows of motion that an autoencoder learns from."""

from collections.abc import Sequence

import numpy as np

from jaxskills.character import Character
from jaxskills.compilation import jit
from jaxskills.env import gram
from jaxskills.motion import Motion

_SIDES = (("left_", "right_"), ("Left", "Right"), ("l_", "r_"))


def cut(
    character: Character, motions: Sequence[Motion], size: int, speeds: Sequence[float]
) -> list[np.ndarray]:
    """Returns for each motion its windows `[M, T, D]` of `size` control frames.

    One begins at each control frame, at each speed, and each comes mirrored too. Features are seen
    from the character (`gram.frame`), so turning a motion would add nothing. What loops goes on
    for ever; what does not and is too short for a window stays at its end.
    """
    rows = (np.concatenate([np.asarray(getattr(m, x)) for m in motions]) for x in ("qpos", "qvel"))
    frames = np.asarray(jit(lambda *x: gram.frames_of(character, *x))(*rows))
    ends = np.cumsum([len(motion.qpos) for motion in motions])
    found = []
    for motion, own in zip(motions, np.split(frames, ends[:-1]), strict=True):
        straight = np.concatenate([_at_speed(motion, own, size, speed) for speed in speeds])
        found.append(np.concatenate((straight, mirrored(character, straight))))
    return found


def _at_speed(motion: Motion, frames: np.ndarray, size: int, speed: float) -> np.ndarray:
    length, intervals = float(motion.length), len(frames) - 1
    along = speed * np.arange(size)
    starts = length if motion.loop else length - along[-1]
    phase = np.arange(max(1, round(starts)))[:, None] + along
    inside = phase % length if motion.loop else np.minimum(phase, length)
    place = inside / length * intervals
    low = np.minimum(place.astype(int), intervals - 1)
    share = (place - low)[..., None]
    found = (1.0 - share) * frames[low] + share * frames[low + 1]
    moving = (phase < length)[..., None] | motion.loop
    found[..., -4:] *= np.where(moving, speed, 0.0)  # velocities
    return found.astype(np.float32)


def mirrored(character: Character, frames: np.ndarray) -> np.ndarray:
    """Returns `frames [..., D]` of the motion seen in a mirror, left and right exchanged.

    A body's mirror image is found by name; a body without one is its own.
    """
    names = character.body_names
    twins = [_twin(name) for name in names]
    index = [names.index(t) if t in names else i for i, t in enumerate(twins)]
    left = np.cross([0.0, 0.0, 1.0], np.asarray(gram.forward(character)))
    vectors = frames[..., :-1].reshape(*frames.shape[:-1], len(names) + 1, 3)
    vectors = vectors[..., [*index, len(names)], :]
    vectors = vectors - 2.0 * (vectors @ left)[..., None] * left
    flat = vectors.reshape(*frames.shape[:-1], -1)
    return np.concatenate((flat, -frames[..., -1:]), axis=-1).astype(frames.dtype)


def _twin(name: str) -> str:
    for one, other in (*_SIDES, *(pair[::-1] for pair in _SIDES)):
        if name.startswith(one):
            return other + name.removeprefix(one)
    return name
