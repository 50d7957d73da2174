"""The left mouse button of the web viewer: it drags bodies, and a click on the ground chooses a place.

In Studio, dragging needs a double-click that selects the body, then a key and another button. This module calls the
same functions of Studio with the left button alone.
"""

from collections.abc import Callable

import mujoco
import numpy as np

from torchrl_mcp.viewer.studio import imgui, ux, viewer_protocol

SLACK = 5.0
"""Largest movement of the mouse during a click, in pixels."""


class Mouse:
    """Handles the left mouse button in the scene of a viewer.

    Args:
        choose: Called with the clicked point on the ground, ``(3,)``, in metres.
    """

    def __init__(self, choose: Callable[[np.ndarray], None]) -> None:
        self._choose = choose
        self._dragging = False
        self._pressed: tuple[float, float, np.ndarray] | None = None  # press on the ground: pixels, and point

    def handle(self, viewer: viewer_protocol.Viewer) -> bool:
        """Process the input of a frame, and return whether a body is dragged: then the camera must not move."""
        io = imgui.GetIO()
        if self._dragging:
            self._drag(viewer, io)
        elif imgui.IsMouseReleased(imgui.MouseButton.Left) and self._pressed is not None:
            x, y, place = self._pressed
            self._pressed = None
            if np.hypot(io.MousePos.x - x, io.MousePos.y - y) <= SLACK:
                self._choose(place)
        elif imgui.IsMouseClicked(imgui.MouseButton.Left):
            self._pressed = None
            if not (io.WantCaptureMouse or io.KeyCtrl or io.DisplaySize.x <= 0):
                self._press(viewer, io)
        return self._dragging

    def _press(self, viewer: viewer_protocol.Viewer, io: imgui.IO) -> None:
        """Start dragging the body under the mouse if it can move, or store the point on the ground."""
        model = viewer.model
        data = viewer.data
        perturb = viewer.perturb
        picked = _pick(viewer, io)
        if picked.body == 0:
            self._pressed = io.MousePos.x, io.MousePos.y, np.array(picked.point)
        elif picked.body > 0 and model.body_weldid[picked.body] > 0:
            perturb.select = picked.body
            perturb.flexselect = -1
            perturb.skinselect = -1
            arm = np.array(picked.point) - data.xpos[picked.body]
            perturb.localpos = data.xmat[picked.body].reshape(3, 3).T @ arm
            ux.InitPerturb(model, data, viewer.camera, perturb, int(mujoco.mjtPertBit.mjPERT_TRANSLATE))
            self._dragging = True

    def _drag(self, viewer: viewer_protocol.Viewer, io: imgui.IO) -> None:
        """Drag the body in the vertical plane, or with Shift in the horizontal plane, until the button is released."""
        if not imgui.IsMouseDown(imgui.MouseButton.Left):
            viewer.perturb.active = 0
            self._dragging = False
            return
        plane = mujoco.mjtMouse.mjMOUSE_MOVE_H if io.KeyShift else mujoco.mjtMouse.mjMOUSE_MOVE_V
        way = io.MouseDelta.x / io.DisplaySize.x, io.MouseDelta.y / io.DisplaySize.y
        ux.MovePerturb(viewer.model, viewer.data, viewer.camera, viewer.perturb, int(plane), *way)


def _pick(viewer: viewer_protocol.Viewer, io: imgui.IO) -> ux.PickResult:
    """Return the body under the mouse, and the point on it."""
    size = io.DisplaySize
    place = io.MousePos.x / size.x, io.MousePos.y / size.y
    return ux.Pick(viewer.model, viewer.data, viewer.camera, *place, size.x / size.y, viewer.vis_options)
