"""Pictures of a simulation without a display, shapes drawn into them, and GIFs."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchrl_mcp.envs.rendering.opengl import new_context

Arrow = tuple[np.ndarray, np.ndarray]
"""Tail and tip, each ``(3,)``, in metres."""

Colour = tuple[float, float, float, float]
"""Red, green, blue and opacity, each from 0 to 1."""

RED: Colour = (0.9, 0.1, 0.1, 1.0)
PALE: Colour = (0.30, 0.58, 0.95, 0.38)

GIF_COLOURS = 64
"""Number of colours of a picture in a GIF: the file is half as large as with 256."""

MAX_SHAPES = 2000
"""Largest number of shapes in a scene, for which MuJoCo reserves memory."""


class Shape(NamedTuple):
    """A shape to draw in addition to a simulation, for ``mujoco.mjv_initGeom``.

    Args:
        kind: Type of geom.
        size: Size of a geom of that type in a model, shape ``(3,)``, in metres.
        position: Position of the centre, or of an arrow's tail, shape ``(3,)``, in metres.
        orientation: Rotation matrix, shape ``(9,)``.
        colour: Red, green, blue and opacity, shape ``(4,)``, float32.
    """

    kind: mujoco.mjtGeom
    size: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    colour: np.ndarray


def arrow(tail: np.ndarray, tip: np.ndarray, colour: Colour = RED) -> Shape:
    """Return an arrow from ``tail`` to ``tip``, each ``(3,)``, in metres."""
    geom = mujoco.MjvGeom()
    kind = mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_connector(geom, kind, 0.05, tail, tip)
    return Shape(kind, geom.size, geom.pos, geom.mat.flatten(), np.array(colour, np.float32))


def ghost(model: mujoco.MjModel, qpos: np.ndarray, colour: Colour = PALE) -> list[Shape]:
    """Return the shapes of all moving bodies of a model in another state.

    Args:
        model: The model; its shapes are spheres, capsules, cylinders, ellipsoids and boxes.
        qpos: The state, shape ``(nq,)``.
        colour: Colour of all shapes.
    """
    data = mujoco.MjData(model)
    data.qpos = qpos
    mujoco.mj_kinematics(model, data)
    moving = np.flatnonzero(model.body_weldid[model.geom_bodyid])
    rgba = np.array(colour, np.float32)
    return [
        Shape(mujoco.mjtGeom(model.geom_type[i]), model.geom_size[i], data.geom_xpos[i], data.geom_xmat[i], rgba)
        for i in moving
    ]


def add_shapes(scene: mujoco.MjvScene, shapes: Iterable[Shape]) -> None:
    """Add shapes to a scene."""
    for geom, shape in zip(scene.geoms[scene.ngeom :], shapes, strict=False):
        mujoco.mjv_initGeom(geom, *shape)
        scene.ngeom += 1


class Camera:
    """A camera that follows a body and draws into memory.

    Args:
        model: The model to draw; its off-screen buffer is enlarged if needed.
        width: Width in pixels.
        height: Height in pixels.
        body: The body to follow, 1 for the first below the world.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
        ValueError: If OpenGL cannot draw pictures of that size.
    """

    def __init__(self, model: mujoco.MjModel, *, width: int, height: int, body: int = 1) -> None:
        buffer = model.vis.global_
        buffer.offwidth = max(buffer.offwidth, width)
        buffer.offheight = max(buffer.offheight, height)
        self._opengl = new_context(width, height)
        self._opengl.make_current()
        try:
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
        except mujoco.FatalError as error:
            self._opengl.free()
            raise ValueError(f"OpenGL cannot draw width={width}, height={height}: pass less ({error})") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._model = model
        self._size = mujoco.MjrRect(0, 0, width, height)
        self.scene = mujoco.MjvScene(model, MAX_SHAPES)
        self.view = mujoco.MjvCamera()
        self.view.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        self.view.trackbodyid = body
        self.view.azimuth, self.view.elevation = 90.0, -30.0

    def picture(
        self, data: mujoco.MjData, arrows: Sequence[Arrow] = (), *, distance: float, shapes: Sequence[Shape] = ()
    ) -> Tensor:
        """Draw the simulation from ``distance`` metres, shape ``(height, width, 3)``, uint8."""
        self.view.distance = distance
        option = mujoco.MjvOption()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, data, option, None, self.view, everything, self.scene)
        add_shapes(self.scene, [*(arrow(*ends) for ends in arrows), *shapes])
        pixels = np.empty((self._size.height, self._size.width, 3), np.uint8)
        self._opengl.make_current()
        mujoco.mjr_render(self._size, self.scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._size, self._context)
        return torch.from_numpy(pixels[::-1].copy())  # OpenGL counts rows from below

    def close(self) -> None:
        """Free the OpenGL context."""
        self._opengl.make_current()
        self._context.free()
        self._opengl.free()


def save_gif(pictures: Iterable[Image.Image], path: Path, *, interval: float) -> None:
    """Write RGB pictures as an animated GIF, one every ``interval`` seconds."""
    # An octree preserves the colours of small areas.
    octree = Image.Quantize.FASTOCTREE
    plain = Image.Dither.NONE
    first, *others = (picture.quantize(GIF_COLOURS, octree, dither=plain) for picture in pictures)
    # A GIF counts in hundredths of a second: rounding errors carry over to the next picture.
    ticks = [round(100 * interval * number) for number in range(len(others) + 2)]
    durations = [10 * (end - begin) for begin, end in pairwise(ticks)]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)
