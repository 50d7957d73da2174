"""Shows a policy in MuJoCo's window, with ghosts, arrows, the weights of primitives, and keys for steering."""

import os
import sys
import time
import warnings
from collections.abc import Callable
from queue import Empty, SimpleQueue

import glfw
import mujoco
import mujoco.viewer
import numpy as np

from torchrl_mcp.envs.rendering.camera import add_shapes
from torchrl_mcp.viewer.film import AZIMUTH, DISTANCE, ELEVATION
from torchrl_mcp.viewer.player import Player, Weights
from torchrl_mcp.viewer.scenery import softly_lit
from torchrl_mcp.viewer.steering import SLOWEST, TURN, Steering

LENGTH = 24
"""Number of strokes that show a weight of 1."""

SLOWER = 0.5
"""Factor on the speed for each press of the slower key."""


class Keyboard:
    """Collects the keys that the window's thread reports, and executes their commands.

    Args:
        steering: The steering to change.

    Attributes:
        paused: Whether the simulation is paused.
        speed: Speed relative to real time.
    """

    def __init__(self, steering: Steering) -> None:
        self.paused = False
        self.speed = 1.0
        self._pressed: SimpleQueue[int] = SimpleQueue()
        self._commands: dict[int, Callable[[], None]] = {
            263: lambda: steering.turn(TURN),  # GLFW's left arrow
            262: lambda: steering.turn(-TURN),  # right
            265: steering.up,
            264: lambda: steering.up(-1),  # down
            259: steering.reset,  # backspace
            257: steering.release_all,  # enter
            ord(" "): steering.stop if steering.can_stop else self._pause,
            ord("-"): lambda: self._pace(SLOWER),
            ord("="): lambda: self._pace(1 / SLOWER),
        }

    def press(self, key: int) -> None:
        """Store a pressed key, by its number in GLFW."""
        self._pressed.put(key)

    def execute(self) -> None:
        """Execute the commands of the keys that were pressed since the last call."""
        while True:
            try:
                command = self._commands.get(self._pressed.get_nowait())
            except Empty:
                return
            if command is not None:
                command()

    def _pause(self) -> None:
        self.paused = not self.paused

    def _pace(self, factor: float) -> None:
        self.speed = max(self.speed * factor, SLOWEST)


def play_in_window(player: Player) -> None:
    """Play until the window is closed, at the speed that the keys set.

    Args:
        player: The player to show.

    Raises:
        RuntimeError: If there is no display.
    """
    require_display()
    steering = Steering(player)
    keyboard = Keyboard(steering)
    model = softly_lit(player.env.simulation.model)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(
        model, data, key_callback=keyboard.press, show_left_ui=False, show_right_ui=False
    ) as viewer:
        camera = viewer.cam
        camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        camera.trackbodyid = 1
        camera.distance = DISTANCE * player.extent
        camera.azimuth = AZIMUTH
        camera.elevation = ELEVATION
        while viewer.is_running():
            due = time.perf_counter() + player.env.control_timestep / keyboard.speed
            keyboard.execute()
            if not keyboard.paused:
                steering.step()
            with viewer.lock():
                mujoco.mj_copyData(data, model, player.data)
                viewer.user_scn.ngeom = 0
                add_shapes(viewer.user_scn, player.shapes)
                apply_mouse(steering, model, data, viewer.perturb)
            if player.weights is not None:
                viewer.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, *as_text(player.weights)))
            viewer.sync()
            time.sleep(max(0.0, due - time.perf_counter()))


def apply_mouse(steering: Steering, model: mujoco.MjModel, data: mujoco.MjData, mouse: mujoco.MjvPerturb) -> None:
    """Push the body that the mouse drags, and place the target at the point selected on the ground.

    Args:
        steering: The steering to change.
        model: The scene.
        data: State of the scene.
        mouse: Selection and drag of the mouse.
    """
    if mouse.select == 0 and mouse.localpos.any():
        steering.put(mouse.localpos)
        mouse.localpos[:] = 0  # place the target only once per selection
    data.xfrc_applied[:] = 0
    mujoco.mjv_applyPerturbForce(model, data, mouse)
    steering.push(np.array(data.xfrc_applied))


def require_display() -> None:
    """Check that there is a display, because MuJoCo would wait for a window forever.

    Raises:
        RuntimeError: If there is no display.
    """
    names = [f"{name}={os.environ[name]}" for name in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(name)]
    if sys.platform != "linux" or (names and _opens()):
        return
    problem = f"{', '.join(names)} cannot be opened" if names else "neither DISPLAY nor WAYLAND_DISPLAY is set"
    raise RuntimeError(
        f"a window needs a display, but {problem}: watch in a browser with --viewer web, or make a film with "
        "--output film.gif"
    )


def _opens() -> bool:
    with warnings.catch_warnings(action="ignore"):
        opens = bool(glfw.init())
    glfw.terminate()
    return opens


def as_text(weights: Weights) -> tuple[str, str]:
    """Return two columns of text: the title with the numbers of the primitives, and the weights as strokes."""
    numbers = [str(number + 1) for number in range(len(weights.values))]
    strokes = ["|" * round(LENGTH * value) for value in weights.values]
    return "\n".join([weights.title, *numbers]), "\n".join(["", *strokes])
