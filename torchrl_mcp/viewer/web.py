"""MuJoCo Studio's web viewer with ghosts, arrows and a panel to steer by."""

import time
from dataclasses import dataclass

import mujoco
from mujoco.experimental.dear_imgui import dear_imgui as imgui
from mujoco.experimental.studio import launch_web, messages, plugin, sim, ux, viewer_app, viewer_protocol

from torchrl_mcp.envs.rendering import Shape
from torchrl_mcp.envs.scenery import softly_lit
from torchrl_mcp.viewer.film import AZIMUTH, DISTANCE, ELEVATION
from torchrl_mcp.viewer.guard import HERE, guarded
from torchrl_mcp.viewer.mouse import Mouse
from torchrl_mcp.viewer.panel import Act, draw
from torchrl_mcp.viewer.player import Player, Weights
from torchrl_mcp.viewer.steering import TURN, Steering

FURTHER = 1.4
"""Times as far as in a film is the camera: a notice of Studio covers the upper part of the page."""

HORIZON, ZENITH = (0.45, 0.78, 1.0, 1.0), (0.25, 0.55, 1.0, 1.0)
"""Of the sky, which Studio draws at a quarter of its brightness: the haze of films would be as grey as a wall."""

KEYS: dict[imgui.Key, Act] = {
    imgui.Key.LeftArrow: lambda steering: steering.turn(TURN),
    imgui.Key.RightArrow: lambda steering: steering.turn(-TURN),
    imgui.Key.UpArrow: lambda steering: steering.play_next_alone(-1),
    imgui.Key.DownArrow: lambda steering: steering.play_next_alone(1),
}
"""What the arrow keys do."""


@dataclass(frozen=True)
class Deed(messages.Event):
    """What somebody does in the browser, for the thread of the simulation.

    Args:
        act: What to do.
    """

    act: Act


class Stage(viewer_app.ViewerApp):
    """MuJoCo Studio's own interface, whose camera follows the character.

    Attributes:
        shapes: What to draw beside the simulation.
        weights: Of the primitives, or None to show no bars.

    The viewer's thread reads these and what is in hand, so that others replace them but do not change them.

    Args:
        steering: What is in hand.
        distance: Of the camera from the character, in metres.
    """

    def __init__(self, steering: Steering, *, distance: float) -> None:
        self.shapes: list[Shape] = []
        self.weights: Weights | None = None
        self._steering, self._distance = steering, distance
        self._mouse = Mouse(lambda place: self._do(lambda steering: steering.put(place)))
        super().__init__(viewer_app.ViewerAppConfig(show_options=False, show_inspector=False))

    def align_camera(self) -> None:
        """Follow the first body below the world, once there is one."""
        camera = self.viewer.camera
        camera.trackbodyid, camera.distance = 1, self._distance
        camera.azimuth, camera.elevation = AZIMUTH, ELEVATION
        following = ux.TRACKING_CAMERA_IDX if self.model.nbody > 1 else ux.FREE_CAMERA_IDX
        self.ux_state.camera_index = ux.set_camera(self.model, camera, following)

    def handle_keyboard_events(self) -> None:
        """Steer with the arrow keys; the others are Studio's."""
        if not imgui.GetIO().WantCaptureKeyboard:
            for key, act in KEYS.items():
                if imgui.IsKeyPressed(key, False):  # once, however long it is held
                    self._do(act)
        super().handle_keyboard_events()

    def handle_mouse_events(self) -> None:
        """Drag bodies and put the target; the rest is Studio's."""
        if not self._mouse.handle(self.viewer):
            super().handle_mouse_events()

    @messages.handler
    def on_update(self, _: messages.UpdateEvent) -> None:
        """Draw the shapes."""
        self.viewer.extra_geoms[:] = [as_geom(shape) for shape in self.shapes]

    @messages.handler
    def on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        """Show the panel."""
        draw(self._steering, self.weights, self._do)

    def _do(self, act: Act) -> None:
        self.viewer.send_to_sim(Deed(act))


class Pace(plugin.SimPlugin):
    """The pace that the viewer's controls set.

    Attributes:
        paused: Whether to wait.
        speed: Relative to real time.
    """

    paused = False
    speed = 1.0

    @messages.handler
    def on_step_control(self, snapshot: messages.StepControlSnapshot) -> None:
        """Take over what the viewer shows."""
        self.paused, self.speed = snapshot.pause_state != sim.PauseState.UNPAUSED, snapshot.speed / 100


class Hands(plugin.SimPlugin):
    """What is done in the browser, done.

    Args:
        steering: Whom to steer.
    """

    def __init__(self, steering: Steering) -> None:
        self._steering = steering

    @messages.handler
    def on_deed(self, deed: Deed) -> None:
        """Do it."""
        deed.act(self._steering)

    @messages.handler
    def on_reset(self, _: messages.ResetEvent) -> None:
        """Begin a new episode."""
        self._steering.reset()


def as_geom(shape: Shape) -> mujoco.MjvGeom:
    """Return a shape as Studio draws it."""
    geom = mujoco.MjvGeom()
    mujoco.mjv_initGeom(geom, *shape)
    return geom


def play_in_browser(player: Player, *, port: int, host: str = HERE) -> None:
    """Play until the viewer is closed, in real time or as its controls say.

    Args:
        player: What to show.
        port: Of the page, 0 for the first free one from 8080.
        host: Address of the interface to listen on; others than this machine can watch, but not control.
    """
    steering, pace = Steering(player), Pace()
    stage = Stage(steering, distance=FURTHER * DISTANCE * player.extent)
    model = softly_lit(player.env.simulation.model, horizon=HORIZON, zenith=ZENITH)
    data = mujoco.MjData(model)
    config = viewer_protocol.ViewerConfig(title="torchrl-mcp-play", http_port=port, open_browser=True)
    with guarded(host), launch_web.launch(config, plugins=[stage, pace, Hands(steering)]) as viewer:
        while viewer.is_running():
            due = time.perf_counter() + player.env.control_timestep / pace.speed
            if not pace.paused:
                steering.step()
            mujoco.mj_copyData(data, model, player.data)
            stage.shapes, stage.weights = player.shapes, player.weights or stage.weights
            viewer.sync(model, data)
            steering.push(data.xfrc_applied)  # where a body is dragged
            time.sleep(max(0.0, due - time.perf_counter()))
