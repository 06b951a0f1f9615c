# SPDX-License-Identifier: Apache-2.0
"""Films: H.264 in .mp4 for every player, and .gif."""

from collections.abc import Generator, Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxskills.errors import UserError
from jaxskills.render import stage
from jaxskills.render.take import Take, beside, lookat

INK = (50, 54, 60)
GREEN = (38, 132, 66)

_GIF_FPS = 15.0  # more makes the file larger, not better
_GIF_COLOURS = 128

# From the front right and a little above: degrees from the direction of travel, degrees, statures.
_AZIMUTH, _ELEVATION, _DISTANCE, _FOVY = 130.0, -10.0, 3.6, 30.0
_BELOW_ROOT = 0.07  # statures; legs come nearer to the camera than heads


def write_mp4(
    path: Path, pictures: Iterator[Image.Image], size: tuple[int, int], fps: float
) -> None:
    """Writes all pictures at their speed.

    Args:
      path: file to write.
      pictures: as of `frames`.
      size: their width and height in pixels, even numbers.
      fps: pictures per s.

    Raises:
      UserError: there is no ffmpeg.
    """
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        raise UserError(
            f"cannot write '{path}': no ffmpeg: run pip install --force-reinstall imageio-ffmpeg"
        ) from None
    path.touch()  # a folder that is not writable is refused here, in the system's own words
    first = next(pictures)  # what cannot be drawn should not leave an encoder behind
    writer = imageio_ffmpeg.write_frames(
        str(path),
        size,
        fps=fps,  # pyright: ignore[reportArgumentType]
        codec="libx264",
        quality=6,  # crf 20
        macro_block_size=2,
        output_params=["-preset", "fast", "-movflags", "+faststart"],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    try:
        writer.send(first.tobytes())
        for picture in pictures:
            writer.send(picture.tobytes())
    finally:
        writer.close()


def write_gif(path: Path, pictures: Iterator[Image.Image], fps: float) -> None:
    """Writes pictures, `fps` of them per s; `gif_step` says how many to leave out before."""
    first, *others = (picture.quantize(_GIF_COLOURS) for picture in pictures)
    duration = round(1000.0 / fps)
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0)


def gif_step(fps: float) -> int:
    """Returns which pictures a .gif shows: every so many-th."""
    return max(round(fps / _GIF_FPS), 1)


def frames(
    take: Take, size: tuple[int, int], overlay: bool, step: int = 1, legend: bool = True
) -> Generator[Image.Image, None, None]:
    """Yields the pictures of a film.

    Args:
      take: what is filmed.
      size: width and height in pixels.
      overlay: draw the ghost where the reference is, not beside the simulation.
      step: leave out all poses but every `step`-th.
      legend: say what the ghost is.
    """
    ghost, middle = take.reference, take.qpos.copy()
    middle[:, 2] -= _BELOW_ROOT * take.body
    if ghost is not None and not overlay:
        ghost = beside(take, ghost)
        middle[:, :2] = (middle[:, :2] + ghost[:, :2]) / 2
    points = lookat(take, middle)
    azimuth = np.degrees(take.heading) + _AZIMUTH
    lens = stage.Lens(azimuth, _ELEVATION, _DISTANCE * take.body, _FOVY)
    font, margin = ImageFont.load_default(size[1] / 24), size[1] / 30
    model, forward = take.character.model, take.character.forward
    with stage.opened(model, forward, lens, *size) as studio:
        for i in range(0, len(take.qpos), step):
            pixels = stage.picture(
                studio, points[i], take.qpos[i], None if ghost is None else ghost[i]
            )
            image = Image.fromarray(pixels)
            draw = ImageDraw.Draw(image)
            told = f"{take.name}   {take.labels[i]}" if take.name else take.labels[i]
            draw.text((margin, margin), told, INK, font)
            if ghost is not None and legend:
                draw.text((size[0] - margin, margin), "green: reference", GREEN, font, anchor="ra")
            yield image
