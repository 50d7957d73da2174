"""MuJoCo's own window, with ghosts, arrows and the weights of primitives."""

import os
import sys
import time

import mujoco
import mujoco.viewer

from torchrl_mcp.envs.rendering import add_shapes
from torchrl_mcp.envs.scenery import softly_lit
from torchrl_mcp.viewer.film import AZIMUTH, DISTANCE, ELEVATION
from torchrl_mcp.viewer.player import Player, Weights

LENGTH = 24
"""Strokes of a weight of 1."""


def play_in_window(player: Player) -> None:
    """Play in real time until the window is closed.

    Args:
        player: What to show.

    Raises:
        RuntimeError: If there is no display.
    """
    require_display()
    model = softly_lit(player.env.simulation.model)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False) as viewer:
        camera = viewer.cam
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        camera.distance, camera.azimuth, camera.elevation = DISTANCE * player.extent, AZIMUTH, ELEVATION
        while viewer.is_running():
            due = time.perf_counter() + player.env.control_timestep
            player.step()
            with viewer.lock():
                mujoco.mj_copyData(data, model, player.data)
                viewer.user_scn.ngeom = 0
                add_shapes(viewer.user_scn, player.shapes)
            if player.weights is not None:
                viewer.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, *as_text(player.weights)))
            viewer.sync()
            time.sleep(max(0.0, due - time.perf_counter()))


def require_display() -> None:
    """Refuse to open a window where none can be: MuJoCo would wait for it for ever.

    Raises:
        RuntimeError: If there is no display.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RuntimeError(
            "a window needs a display, and neither DISPLAY nor WAYLAND_DISPLAY names one: watch in a browser with "
            "--viewer web, or make a film with --output film.gif"
        )


def as_text(weights: Weights) -> tuple[str, str]:
    """Return two columns of text: the numbers of the primitives below the title, and their weights as strokes."""
    numbers = [str(number + 1) for number in range(len(weights.values))]
    strokes = ["|" * round(LENGTH * value) for value in weights.values]
    return "\n".join([weights.title, *numbers]), "\n".join(["", *strokes])
