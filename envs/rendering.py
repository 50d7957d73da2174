"""Pictures of a simulation, without a display."""

from typing import ClassVar

import mujoco
import numpy as np
import torch
from torch import Tensor

Arrow = tuple[np.ndarray, np.ndarray]
"""Tail and tip, each ``(3,)``, in metres."""


class Camera:
    """A camera that follows a body and draws into memory.

    Args:
        model: The model to draw; its off-screen buffer is enlarged where the picture needs it.
        width: Pixels.
        height: Pixels.
        body: The body to follow, 1 for the first below the world.

    Raises:
        RuntimeError: If no OpenGL library for drawing without a display is found.
    """

    _failure: ClassVar[Exception | None] = None  # MuJoCo ends the process when asked again

    def __init__(self, model: mujoco.MjModel, *, width: int, height: int, body: int = 1) -> None:
        buffer = model.vis.global_
        buffer.offwidth, buffer.offheight = max(buffer.offwidth, width), max(buffer.offheight, height)
        if Camera._failure is None:
            try:
                self.renderer = mujoco.Renderer(model, height, width)
            except (AttributeError, ImportError, RuntimeError, mujoco.FatalError) as error:
                Camera._failure = error
        if Camera._failure is not None:
            raise RuntimeError(
                "MuJoCo found no OpenGL to draw with. Without a display, set the environment variable MUJOCO_GL before "
                "Python starts: to egl (Debian: apt install libegl1) or to osmesa (Debian: apt install libosmesa6)"
            ) from Camera._failure
        self.view = mujoco.MjvCamera()
        self.view.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        self.view.trackbodyid = body
        self.view.azimuth, self.view.elevation = 90.0, -30.0

    def picture(self, data: mujoco.MjData, arrows: list[Arrow], *, distance: float) -> Tensor:
        """Draw the simulation from ``distance`` metres, shape ``(height, width, 3)``, uint8."""
        self.view.distance = distance
        self.renderer.update_scene(data, self.view)
        scene = self.renderer.scene
        for tail, tip in arrows:
            geom = scene.geoms[scene.ngeom]
            red, arrow = np.array([0.9, 0.1, 0.1, 1.0], np.float32), mujoco.mjtGeom.mjGEOM_ARROW
            mujoco.mjv_initGeom(geom, arrow, np.zeros(3), np.zeros(3), np.zeros(9), red)
            mujoco.mjv_connector(geom, arrow, 0.05, tail, tip)
            scene.ngeom += 1
        return torch.from_numpy(self.renderer.render())

    def close(self) -> None:
        """Free the OpenGL context."""
        self.renderer.close()
