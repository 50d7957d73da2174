"""The panel of the web viewer: the target direction, and the gates as bars that can be taken in hand."""

from collections.abc import Callable

from mujoco.experimental.dear_imgui import dear_imgui as imgui
from PIL import ImageColor

from torchrl_mcp.analysis.figures import colours
from torchrl_mcp.viewer.player import Weights
from torchrl_mcp.viewer.steering import Steering

Act = Callable[[Steering], None]
"""What somebody does."""

WIDTH, HEIGHT = 160.0, 14.0
"""Of a bar, in pixels."""

KEYS = "drag a body: push\nspace: pause   - =: slower, faster\nup, down: one primitive alone"


def draw(steering: Steering, weights: Weights | None, do: Callable[[Act], None]) -> None:
    """Draw the panel for a frame.

    Args:
        steering: What is in hand, to be read alone.
        weights: Of the primitives, or None without.
        do: Hands on what somebody does.
    """
    imgui.SetNextWindowPos(imgui.Vec2(16, 48), int(imgui.Cond.FirstUseEver))
    imgui.Begin("steer", flags=int(imgui.WindowFlags.AlwaysAutoResize) | int(imgui.WindowFlags.NoNav))
    if steering.has_direction:
        imgui.SetNextItemWidth(WIDTH)
        turned, angle = imgui.SliderAngle("direction", steering.target_direction, -180.0, 180.0)
        if turned:
            do(lambda steering: steering.aim(angle))
        imgui.TextDisabled("left, right: turn by 15 degrees")
    if steering.has_place:
        imgui.TextDisabled("click on the ground: place the target")
    if weights is not None:
        _draw_weights(steering, weights, do)
    if imgui.Button("new episode"):
        do(Steering.reset)
    imgui.SameLine()
    if imgui.Button("let go"):
        do(Steering.let_go)
    imgui.TextDisabled(KEYS)
    imgui.End()


def _draw_weights(steering: Steering, weights: Weights, do: Callable[[Act], None]) -> None:
    """Draw a bar for each primitive. Where it is held the gate is pinned; its number lets the primitive act alone."""
    imgui.Text(weights.title)
    for number, (value, shown) in enumerate(zip(weights.values, colours(len(weights.values)), strict=True)):
        red, green, blue = (part / 255 for part in ImageColor.getrgb(shown)[:3])
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
            do(_pin(number, (imgui.GetMousePos().x - left) / WIDTH))
        imgui.SameLine()
        if imgui.SmallButton(f"{number + 1}"):
            do(_play_alone(number))
        if number in steering.player.pinned:
            imgui.SameLine()
            if imgui.SmallButton(f"release##{number}"):
                do(_release(number))


def _pin(primitive: int, weight: float) -> Act:
    return lambda steering: steering.pin(primitive, weight)


def _release(primitive: int) -> Act:
    return lambda steering: steering.release(primitive)


def _play_alone(primitive: int) -> Act:
    return lambda steering: steering.play_alone(primitive)
