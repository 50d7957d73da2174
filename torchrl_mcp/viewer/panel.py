"""The panel of the web viewer: a slider for the target direction, and a bar for every gate, which can be dragged."""

from collections.abc import Callable
from functools import partial

from PIL import ImageColor

from torchrl_mcp.analysis.figures import colours
from torchrl_mcp.viewer.player import Weights
from torchrl_mcp.viewer.steering import Steering
from torchrl_mcp.viewer.studio import imgui

Command = Callable[[Steering], None]
"""A user's command to the steering."""

WIDTH, HEIGHT = 160.0, 14.0
"""Size of a bar in pixels."""

NARROW = 500
"""Displays of fewer pixels show the panel at the bottom, because Studio's box at the top would cover it."""


def draw(steering: Steering, weights: Weights | None, send: Callable[[Command], None]) -> None:
    """Draw the panel for one frame.

    Args:
        steering: Current steering, which is only read.
        weights: Weights of the primitives, or None without primitives.
        send: Called with the user's commands.
    """
    display = imgui.GetIO().DisplaySize
    imgui.SetNextWindowPos(*place(display.x, display.y))
    imgui.Begin("steer", flags=int(imgui.WindowFlags.AlwaysAutoResize) | int(imgui.WindowFlags.NoNav))
    if steering.has_direction:
        imgui.SetNextItemWidth(WIDTH)
        turned, angle = imgui.SliderAngle("direction", steering.target_direction, -180.0, 180.0)
        if turned:
            send(lambda steering: steering.aim(angle))
        imgui.TextDisabled("left, right: turn by 15 degrees")
    if steering.has_speed:
        imgui.TextDisabled(f"up, down: speed, now {steering.target_speed:.2f} m/s")
    if steering.has_place:
        imgui.TextDisabled("click on the ground: place the target")
    if weights is not None:
        _draw_weights(steering, weights, send)
    if imgui.Button("new episode"):
        send(Steering.reset)
    imgui.SameLine()
    if imgui.Button("release all"):
        send(Steering.release_all)
    imgui.TextDisabled(f"drag a body: push\nspace: {'stop' if steering.can_stop else 'pause'}   - =: slower, faster")
    if not steering.has_speed:
        imgui.TextDisabled("up, down: let one primitive act alone")
    imgui.End()


def place(width: float, height: float) -> tuple[imgui.Vec2, int, imgui.Vec2]:
    """Return position, condition and pivot of the panel, as :func:`imgui.SetNextWindowPos` expects them.

    The panel begins in the upper left corner, or on narrow displays in the lower left corner, where Studio's box does
    not cover it.

    Args:
        width: Width of the display in pixels.
        height: Height of the display in pixels.
    """
    if width >= NARROW:
        return imgui.Vec2(16, 48), int(imgui.Cond.FirstUseEver), imgui.Vec2(0, 0)
    # In every frame, because the first size of the display is not yet the browser's.
    return imgui.Vec2(16, height - 48), int(imgui.Cond.Always), imgui.Vec2(0, 1)


def _draw_weights(steering: Steering, weights: Weights, send: Callable[[Command], None]) -> None:
    """Draw a bar for each primitive. Dragging it pins the gate; a click on its number lets the primitive act alone."""
    imgui.Text(weights.title)
    for number, (value, colour) in enumerate(zip(weights.values, colours(len(weights.values)), strict=True)):
        red, green, blue = (part / 255 for part in ImageColor.getrgb(colour)[:3])
        corner = imgui.GetCursorPos()
        imgui.PushStyleColor(int(imgui.Col.PlotHistogram), imgui.Vec4(red, green, blue, 1.0))
        imgui.ProgressBar(steering.player.pinned.get(number, value), imgui.Vec2(WIDTH, HEIGHT), "")
        imgui.PopStyleColor()
        left = imgui.GetItemRectMin().x
        if not steering.player.has_gates:
            imgui.SameLine()
            imgui.Text(str(number + 1))
            continue
        imgui.SetCursorPos(corner)
        imgui.InvisibleButton(f"bar{number}", imgui.Vec2(WIDTH, HEIGHT))
        if imgui.IsItemActive():
            send(partial(Steering.pin, primitive=number, weight=(imgui.GetMousePos().x - left) / WIDTH))
        imgui.SameLine()
        if imgui.SmallButton(f"{number + 1}"):
            send(partial(Steering.play_alone, primitive=number))
        if number in steering.player.pinned:
            imgui.SameLine()
            if imgui.SmallButton(f"release##{number}"):
                send(partial(Steering.release, primitive=number))
