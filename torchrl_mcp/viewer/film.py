"""Renders policies as films."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps
from tensordict.nn import TensorDictModuleBase
from tqdm import tqdm

from torchrl_mcp.analysis.figures import INK
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.rendering.camera import Camera, save_gif
from torchrl_mcp.evaluation.bars import bar
from torchrl_mcp.evaluation.formats import ENCODER, EVERY, require_format
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.viewer.bars import draw_bars
from torchrl_mcp.viewer.player import Player
from torchrl_mcp.viewer.scenery import softly_lit

AZIMUTH, ELEVATION = 115.0, -26.0
"""Angles of the camera in degrees, which sees a character that walks along x from the right, from slightly in front
and from above."""

DISTANCE = 2.8
"""Distance of the camera from the character, as a multiple of the character's extent."""

LAG = 0.25
"""Time constant with which the camera follows the character, in seconds."""


def film(player: Player, *, seconds: float, width: int, height: int, every: int) -> Iterator[Image.Image]:
    """Play, and draw the character, the target or reference of its task, and the weights of its primitives.

    The camera follows the character smoothly, and jumps when an episode begins.

    Args:
        player: The player to film.
        seconds: Duration in seconds.
        width: Width in pixels.
        height: Height in pixels.
        every: Control steps per picture.

    Yields:
        RGB pictures.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
    """
    if not player.simulated:
        yield from rendered_pictures(player, seconds=seconds, width=width, height=height, every=every)
        return
    timestep = player.env.control_timestep
    model = softly_lit(player.env.simulation.model)
    camera = Camera(model, width=width, height=height)
    distance = DISTANCE * player.extent
    camera.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = True
    camera.view.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.view.azimuth, camera.view.elevation = AZIMUTH, ELEVATION
    camera.view.lookat = player.data.subtree_com[1]
    lag = min(1.0, player.extent)  # small characters leave the picture sooner
    fixed = model.light_bodyid == 0  # these lights follow the character, because MuJoCo draws shadows only near them
    try:
        for step in range(round(seconds / timestep)):
            player.step()
            data = player.data
            centre = data.subtree_com[1]
            camera.view.lookat = centre if player.began else followed(camera.view.lookat, centre, timestep / lag)
            data.light_xpos[fixed, :2] += centre[:2]
            if step % every == every - 1:
                picture = camera.picture(data, distance=distance, shapes=player.shapes)
                yield _with_weights(Image.fromarray(picture.numpy()), player)
    finally:
        camera.close()


def rendered_pictures(player: Player, *, seconds: float, width: int, height: int, every: int) -> Iterator[Image.Image]:
    """Play, and yield pictures that an environment of another library renders; arguments as of :func:`film`."""
    for step in range(round(seconds / player.env.control_timestep)):
        player.step()
        if step % every == every - 1:
            picture = Image.fromarray(player.env.render().numpy())
            yield _with_weights(ImageOps.pad(picture, (width, height)), player)


def _with_weights(picture: Image.Image, player: Player) -> Image.Image:
    """Draw the weights of the primitives on a picture, if there are any."""
    if player.weights is not None:
        draw_bars(picture, player.weights.values, player.weights.title)
    return picture


def followed(place: np.ndarray, target: np.ndarray, seconds: float) -> np.ndarray:
    r"""Return the next focus of the camera, :math:`x + (1 - e^{-t/\tau}) (x^* - x)`.

    The focus stays :math:`v \tau` behind a target of constant velocity :math:`v`, where :math:`\tau` is :data:`LAG`.

    Args:
        place: Last focus :math:`x`, ``(3,)``, in metres.
        target: Position :math:`x^*` of the character, ``(3,)``, in metres.
        seconds: Time :math:`t` since the last focus.
    """
    return place + (1 - math.exp(-seconds / LAG)) * (target - place)


def save_film(
    policy: TensorDictModuleBase,
    env: CharacterEnv | TransformedCharacterEnv,
    path: Path,
    *,
    seconds: float = 8.0,
    width: int = 320,
    height: int = 240,
    deterministic: bool = True,
    num_options: int = 0,
    aside: float = 1.0,
) -> None:
    """Write a :func:`film` as an animated GIF or an MP4 that plays in real time.

    Args:
        policy: From the environment's observations to ``action``, on the CPU.
        env: Environments, of which the first is filmed; when an episode ends, the next begins.
        path: The file, ``.gif`` or ``.mp4``.
        seconds: Duration in seconds.
        width: Width in pixels.
        height: Height in pixels.
        deterministic: Play the deterministic action instead of a sample.
        num_options: Number of options of the policy, 0 without options.
        aside: Distance of a ghost from the character, as a multiple of the character's extent.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
        ValueError: If an argument is out of range, or as :func:`~torchrl_mcp.evaluation.formats.require_format`.
    """
    player = Player(policy, env, deterministic=deterministic, num_options=num_options, aside=aside)
    save_films({"": player}, path, seconds=seconds, width=width, height=height)


def save_films(players: Mapping[str, Player], path: Path, *, seconds: float, width: int, height: int) -> None:
    """Write the :func:`film` of every player, side by side, as one animated GIF or MP4.

    Args:
        players: Players by the titles of their pictures, all with the same control timestep.
        path: The file, ``.gif`` or ``.mp4``.
        seconds: Duration in seconds.
        width: Width of each player's picture in pixels.
        height: Height in pixels.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
        ValueError: If an argument is out of range, or as :func:`~torchrl_mcp.evaluation.formats.require_format`.
    """
    require_format(path)
    save = {".gif": save_gif, ".mp4": save_mp4}[path.suffix]
    every = EVERY[path.suffix]
    timestep = next(iter(players.values())).env.control_timestep
    interval = every * timestep
    if round(seconds / timestep) < every:
        raise ValueError(f"seconds={seconds} is too short for a picture: pass at least {interval:.2f}")
    if width < 2 or height < 2:
        raise ValueError(f"width={width} and height={height} are too small for a picture: pass at least 2 pixels each")
    path.parent.mkdir(parents=True, exist_ok=True)
    films = [film(player, seconds=seconds, width=width, height=height, every=every) for player in players.values()]
    pictures = (_beside(row, list(players)) for row in zip(*films, strict=True))
    with bar(round(seconds / interval), path.name) as shown:
        save(_counted(pictures, shown), path, interval=interval)


def _beside(pictures: Sequence[Image.Image], titles: Sequence[str]) -> Image.Image:
    """Return pictures of one size in a row, each with its title at the bottom."""
    width, height = pictures[0].size
    row = Image.new("RGB", (len(pictures) * width, height))
    draw = ImageDraw.Draw(row)
    font = ImageFont.load_default(height / 14)
    for column, (picture, title) in enumerate(zip(pictures, titles, strict=True)):
        row.paste(picture, (column * width, 0))
        draw.text(((column + 0.5) * width, 0.97 * height), title, fill=INK, font=font, anchor="mb")
    return row


def _counted(pictures: Iterable[Image.Image], shown: tqdm) -> Iterator[Image.Image]:
    for picture in pictures:
        yield picture
        shown.update()


def save_mp4(pictures: Iterable[Image.Image], path: Path, *, interval: float) -> None:
    """Write RGB pictures, one every ``interval`` seconds, as an MP4 (H.264) with imageio-ffmpeg."""
    ffmpeg = import_module(ENCODER)
    writer = None
    for picture in pictures:
        if writer is None:
            # H.264 halves the resolution of colours, so width and height must be even.
            writer = ffmpeg.write_frames(str(path), picture.size, fps=1 / interval, macro_block_size=2)
            writer.send(None)
        writer.send(np.asarray(picture))
    if writer is not None:
        writer.close()
