"""Pictures of clips: contact sheets and films."""

import math
from collections.abc import Iterator
from pathlib import Path

import mujoco
import torch
from PIL import Image
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.rendering.camera import Camera, save_gif
from torchrl_mcp.envs.rendering.ground import add_ground
from torchrl_mcp.envs.rotations import heading

FILM_FPS = 25.0
"""Pictures per second of a film."""


def pictures(clip: MotionClip, times: Tensor, *, size: int, follow_heading: bool) -> Iterator[Tensor]:
    """Draw a clip from the character's right, so that it moves to the right in the picture.

    Args:
        clip: The clip.
        times: Times in seconds since the first frame, shape ``(M,)``.
        size: Width and height in pixels.
        follow_heading: Turn the camera with the character, not only move it along.

    Yields:
        Pictures, shape ``(size, size, 3)``, uint8.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
    """
    model = _scene(clip.character)
    distance = 1.7 * character_model(clip.character).stat.extent
    data = mujoco.MjData(model)
    camera = Camera(model, width=size, height=size)
    qpos = clip.at(times)
    azimuths = 90.0 + heading(qpos[:, 3:7]).rad2deg()
    camera.view.elevation = -10.0
    try:
        for state, azimuth in zip(qpos.numpy(), azimuths.tolist(), strict=True):
            camera.view.azimuth = azimuth if follow_heading else float(azimuths[0])
            data.qpos = state
            mujoco.mj_forward(model, data)
            yield camera.picture(data, [], distance=distance)
    finally:
        camera.close()


def _scene(character: str) -> mujoco.MjModel:
    """A character on the ground below a sky."""
    spec = CHARACTERS[character].spec()
    add_ground(spec)
    spec.visual.quality.shadowsize = 2048
    return spec.compile()


def contact_sheet(clip: MotionClip, *, columns: int = 8, rows: int = 3, size: int = 200) -> Tensor:
    """Draw a clip at equal intervals, including its beginning and end, row by row.

    Args:
        clip: The clip.
        columns: Pictures in a row.
        rows: Number of rows.
        size: Width and height of each picture, in pixels.

    Returns:
        Picture, shape ``(rows * size, columns * size, 3)``, uint8.
    """
    times = torch.linspace(0, clip.duration, columns * rows, dtype=torch.float64)
    drawn = torch.stack(list(pictures(clip, times, size=size, follow_heading=True)))
    return drawn.view(rows, columns, size, size, 3).transpose(1, 2).reshape(rows * size, columns * size, 3)


def save_picture(picture: Tensor, path: str | Path) -> None:
    """Write a picture, shape ``(height, width, 3)``, uint8, in the format of the file's suffix."""
    Image.fromarray(picture.numpy()).save(path)


def save_film(clip: MotionClip, path: str | Path, *, seconds: float = math.inf, size: int = 320) -> None:
    """Write a clip, or its beginning, as an animated GIF that plays at the speed of the motion.

    Args:
        clip: The clip.
        path: The file.
        seconds: Longest duration to draw.
        size: Width and height in pixels.
    """
    times = torch.arange(0, min(clip.duration, seconds), 1 / FILM_FPS, dtype=torch.float64)
    drawn = pictures(clip, times, size=size, follow_heading=False)
    save_gif((Image.fromarray(picture.numpy()) for picture in drawn), Path(path), interval=1 / FILM_FPS)
