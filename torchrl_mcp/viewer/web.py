"""MuJoCo Studio's web viewer with ghosts, arrows and the weights of primitives added."""

import time

import mujoco
from mujoco.experimental.dear_imgui import dear_imgui as imgui
from mujoco.experimental.studio import launch_web, messages, plugin, sim, ux, viewer_app, viewer_protocol
from PIL import ImageColor

from torchrl_mcp.analysis.figures import colours
from torchrl_mcp.envs.rendering import Shape
from torchrl_mcp.envs.scenery import softly_lit
from torchrl_mcp.viewer.film import AZIMUTH, DISTANCE, ELEVATION
from torchrl_mcp.viewer.guard import HERE, guarded
from torchrl_mcp.viewer.player import Player, Weights

FURTHER = 1.4
"""Times as far as in a film is the camera: a notice of Studio covers the upper part of the page."""


class Stage(viewer_app.ViewerApp):
    """MuJoCo Studio's own interface, whose camera follows the character.

    Attributes:
        shapes: What to draw beside the simulation.
        weights: Of the primitives, or None to show no panel.

    The viewer's thread reads these, so that others replace them but do not change them.

    Args:
        distance: Of the camera from the character, in metres.
    """

    def __init__(self, *, distance: float) -> None:
        self.shapes: list[Shape] = []
        self.weights: Weights | None = None
        self._distance = distance
        super().__init__(viewer_app.ViewerAppConfig(show_options=False, show_inspector=False))

    def align_camera(self) -> None:
        """Follow the first body below the world, once there is one."""
        camera = self.viewer.camera
        camera.trackbodyid, camera.distance = 1, self._distance
        camera.azimuth, camera.elevation = AZIMUTH, ELEVATION
        following = ux.TRACKING_CAMERA_IDX if self.model.nbody > 1 else ux.FREE_CAMERA_IDX
        self.ux_state.camera_index = ux.set_camera(self.model, camera, following)

    @messages.handler
    def on_update(self, _: messages.UpdateEvent) -> None:
        """Draw the shapes."""
        self.viewer.extra_geoms[:] = [as_geom(shape) for shape in self.shapes]

    @messages.handler
    def on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        """Show the weights as bars."""
        if (weights := self.weights) is None:
            return
        imgui.SetNextWindowPos(imgui.Vec2(16, 48), int(imgui.Cond.FirstUseEver))
        imgui.Begin(weights.title, flags=int(imgui.WindowFlags.AlwaysAutoResize))
        for number, (value, shown) in enumerate(zip(weights.values, colours(len(weights.values)), strict=True)):
            red, green, blue = ImageColor.getrgb(shown)[:3]
            colour = imgui.Vec4(red / 255, green / 255, blue / 255, 1.0)
            imgui.PushStyleColor(int(imgui.Col.PlotHistogram), colour)
            imgui.ProgressBar(value, imgui.Vec2(160, 14), "")
            imgui.PopStyleColor()
            imgui.SameLine()
            imgui.Text(str(number + 1))
        imgui.End()


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
    stage, pace = Stage(distance=FURTHER * DISTANCE * player.extent), Pace()
    model = softly_lit(player.env.simulation.model)
    data = mujoco.MjData(model)
    config = viewer_protocol.ViewerConfig(title="torchrl-mcp-play", http_port=port, open_browser=True)
    with guarded(host), launch_web.launch(config, plugins=[stage, pace]) as viewer:
        while viewer.is_running():
            due = time.perf_counter() + player.env.control_timestep / pace.speed
            if not pace.paused:
                player.step()
            mujoco.mj_copyData(data, model, player.data)
            stage.shapes, stage.weights = player.shapes, player.weights
            viewer.sync(model, data)
            time.sleep(max(0.0, due - time.perf_counter()))
