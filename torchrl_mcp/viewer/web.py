"""MuJoCo Studio's web viewer, extended by ghosts, arrows and a panel for steering."""

import time
from dataclasses import dataclass

import mujoco

from torchrl_mcp.envs.rendering.camera import Shape
from torchrl_mcp.viewer.film import AZIMUTH, DISTANCE, ELEVATION
from torchrl_mcp.viewer.guard import guarded
from torchrl_mcp.viewer.mouse import Mouse
from torchrl_mcp.viewer.panel import Command, draw
from torchrl_mcp.viewer.player import Player, Weights
from torchrl_mcp.viewer.scenery import softly_lit
from torchrl_mcp.viewer.steering import SLOWEST, TURN, Steering
from torchrl_mcp.viewer.studio import (
    App,
    Config,
    imgui,
    launch_web,
    messages,
    plugin,
    sim,
    ux,
    viewer_protocol,
)

FURTHER = 1.4
"""Factor on the distance of the camera in films, because a notice of Studio covers the upper part of the page."""

HORIZON = (0.45, 0.78, 1.0, 1.0)
"""Colour of the sky at the horizon. Studio draws the sky at a quarter of its brightness, so haze would look grey."""

ZENITH = (0.25, 0.55, 1.0, 1.0)
"""Colour of the sky at the zenith."""

KEYS: dict[imgui.Key, Command] = {
    imgui.Key.LeftArrow: lambda steering: steering.turn(TURN),
    imgui.Key.RightArrow: lambda steering: steering.turn(-TURN),
    imgui.Key.UpArrow: lambda steering: steering.up(),
    imgui.Key.DownArrow: lambda steering: steering.up(-1),
}
"""Commands of the arrow keys."""


@dataclass(frozen=True)
class BrowserEvent(messages.Event):
    """Carries a user's command from the browser to the simulation's thread.

    Args:
        command: The command.
    """

    command: Command


class StudioApp(App):
    """MuJoCo Studio's interface with the panel, and with a camera that follows the character.

    The viewer's thread reads the attributes and the steering. Other threads must therefore replace the attributes and
    not change them in place.

    Args:
        steering: Current steering, which is only read.
        distance: Distance of the camera from the character, in metres.

    Attributes:
        shapes: Shapes to draw in addition to the simulation.
        weights: Weights of the primitives, or None for no bars.
    """

    def __init__(self, steering: Steering, *, distance: float) -> None:
        self.shapes: list[Shape] = []
        self.weights: Weights | None = None
        self._steering = steering
        self._distance = distance
        self._mouse = Mouse(lambda place: self._send(lambda steering: steering.put(place)))
        super().__init__(Config(show_options=False, show_inspector=False))

    def align_camera(self) -> None:
        """Follow the first body of the scene, as soon as the scene is loaded."""
        camera = self.viewer.camera
        camera.trackbodyid = 1
        camera.distance = self._distance
        camera.azimuth, camera.elevation = AZIMUTH, ELEVATION
        following = ux.TRACKING_CAMERA_IDX if self.model.nbody > 1 else ux.FREE_CAMERA_IDX
        self.ux_state.camera_index = ux.set_camera(self.model, camera, following)

    def handle_keyboard_events(self) -> None:
        """Steer with the arrow keys, and with Space in tasks that can stop; Studio handles the other keys."""
        keys = KEYS | ({imgui.Key.Space: Steering.stop} if self._steering.can_stop else {})
        pressed = [key for key in keys if imgui.IsKeyPressed(key, False)]  # without repeats
        if pressed and not imgui.GetIO().WantCaptureKeyboard:
            for key in pressed:
                self._send(keys[key])
        else:
            super().handle_keyboard_events()

    def handle_mouse_events(self) -> None:
        """Drag bodies and place the target; Studio handles all other input of the mouse."""
        if not self._mouse.handle(self.viewer):
            super().handle_mouse_events()

    @messages.handler
    def on_update(self, _: messages.UpdateEvent) -> None:
        """Draw the shapes."""
        self.viewer.extra_geoms[:] = [as_geom(shape) for shape in self.shapes]

    @messages.handler
    def on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        """Show the panel."""
        draw(self._steering, self.weights, self._send)

    def _send(self, command: Command) -> None:
        self.viewer.send_to_sim(BrowserEvent(command))


class Pace(plugin.SimPlugin):
    """Pause and speed as the viewer's controls set them.

    Attributes:
        paused: Whether the simulation is paused.
        speed: Speed relative to real time.
    """

    paused = False
    speed = 1.0

    @messages.handler
    def on_step_control(self, snapshot: messages.StepControlSnapshot) -> None:
        """Copy the viewer's settings."""
        self.paused = snapshot.pause_state != sim.PauseState.UNPAUSED
        self.speed = snapshot.speed / 100


class BrowserInput(plugin.SimPlugin):
    """Executes the browser's commands in the simulation's thread.

    Args:
        steering: The steering to change.
    """

    def __init__(self, steering: Steering) -> None:
        self._steering = steering

    @messages.handler
    def on_browser_event(self, event: BrowserEvent) -> None:
        """Execute a command."""
        event.command(self._steering)

    @messages.handler
    def on_reset(self, _: messages.ResetEvent) -> None:
        """Begin a new episode."""
        self._steering.reset()


def as_geom(shape: Shape) -> mujoco.MjvGeom:
    """Convert a shape to the type that Studio draws."""
    geom = mujoco.MjvGeom()
    mujoco.mjv_initGeom(geom, *shape)
    return geom


def play_in_browser(player: Player, *, port: int) -> None:
    """Play until the viewer is closed, at the speed that its controls set.

    Args:
        player: The player to show.
        port: Port of the page; 0 takes the first free port from 8080.

    Raises:
        RuntimeError: If access to this version of Studio cannot be restricted to this machine.
    """
    steering = Steering(player)
    pace = Pace()
    app = StudioApp(steering, distance=FURTHER * DISTANCE * player.extent)
    model = softly_lit(player.env.simulation.model, horizon=HORIZON, zenith=ZENITH)
    data = mujoco.MjData(model)
    config = viewer_protocol.ViewerConfig(title="torchrl-mcp-play", http_port=port, open_browser=True)
    with guarded(), launch_web.launch(config, plugins=[app, pace, BrowserInput(steering)]) as viewer:
        while viewer.is_running():
            due = time.perf_counter() + player.env.control_timestep / max(pace.speed, SLOWEST)
            if not pace.paused:
                steering.step()
            mujoco.mj_copyData(data, model, player.data)
            app.shapes = player.shapes
            app.weights = player.weights or app.weights
            viewer.sync(model, data)
            steering.push(data.xfrc_applied)  # the force on a dragged body
            time.sleep(max(0.0, due - time.perf_counter()))
