"""Objects of a scene beside the character: where they are, and how they are placed."""

from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.physics.simulation import Simulation


class SceneObject:
    """A body of the scene with live views of its pose in N simulations, made once.

    The object either moves freely, by joints with the coordinates of a free joint, or stays where it is put, as a mocap
    body.

    Args:
        simulation: The simulations.
        name: Name of the body.

    Attributes:
        position: Position after the last step, ``(N, 3)``, in metres; read-only.
        orientation: Orientation after the last step, ``(N, 4)``, a quaternion; read-only.
        next_position: Position in the state with which the next step begins, ``(N, 3)``; writing moves the object.
        next_orientation: Orientation in this state, ``(N, 4)``.
        next_velocity: Linear velocity in this state, ``(N, 3)``, in m/s, and angular velocity, ``(N, 6)`` together;
            empty for an object that is put.
        rest: Position in the scene's rest pose, ``(3,)``.
    """

    def __init__(self, simulation: Simulation, name: str) -> None:
        body = simulation.model.body(name)
        self._mocap = int(body.mocapid[0])
        self.position = simulation.outputs["xpos"][:, body.id]
        self.orientation = simulation.outputs["xquat"][:, body.id]
        self.rest = torch.from_numpy(body.pos.copy()).to(self.position)
        joint = simulation.model.jnt(int(body.jntadr[0])) if self._mocap < 0 else None
        self._first = int(joint.qposadr[0]) if joint else 0
        self.next_position = self._position_in(simulation.state)
        self.next_orientation = self._orientation_in(simulation.state)
        speeds = slice(int(joint.dofadr[0]), int(joint.dofadr[0]) + 6) if joint else slice(0)
        self.next_velocity = simulation.state["qvel"][:, speeds]

    @property
    def pose(self) -> tuple[Tensor, Tensor]:
        """Position and orientation after the last step."""
        return self.position, self.orientation

    def put(self, start: Mapping[str, Tensor], place: Tensor | None = None, orientation: Tensor | None = None) -> None:
        """Put the object somewhere at the beginning of ``n`` episodes.

        Args:
            start: Initial states, ``(n, ...)`` each, which are changed.
            place: Place on the ground, ``(n, 2)``, in metres, at the height of the rest pose; None to leave it.
            orientation: Orientation, ``(n, 4)``, a quaternion; None to leave it.
        """
        if place is not None:
            self._position_in(start)[:, :2] = place
        if orientation is not None:
            self._orientation_in(start)[:] = orientation

    def place(self, start: Mapping[str, Tensor]) -> Tensor:
        """Place on the ground at the beginning of ``n`` episodes, a view of initial states, ``(n, 2)``."""
        return self._position_in(start)[:, :2]

    def _position_in(self, state: Mapping[str, Tensor]) -> Tensor:
        if self._mocap >= 0:
            return state["mocap_pos"][:, self._mocap]
        return state["qpos"][:, self._first : self._first + 3]

    def _orientation_in(self, state: Mapping[str, Tensor]) -> Tensor:
        if self._mocap >= 0:
            return state["mocap_quat"][:, self._mocap]
        return state["qpos"][:, self._first + 3 : self._first + 7]


def horizontal_extent(model: mujoco.MjModel, num_bodies: int, poses: Tensor, low: float, high: float) -> float:
    """Horizontal extent of a character from its root.

    Args:
        model: The scene, whose first bodies are the character's.
        num_bodies: Number of the character's bodies.
        poses: Coordinates of the character, ``(P, nq)``.
        low: Lowest height to include, in metres.
        high: Highest height to include, in metres.

    Returns:
        Largest radius in metres of the boxes around the character's shapes, over all poses.
    """
    data = mujoco.MjData(model)
    radius = 0.0
    of_character = np.flatnonzero(
        (model.geom_bodyid > 0) & (model.geom_bodyid <= num_bodies) & (model.geom_conaffinity > 0)
    )
    for pose in poses.cpu().numpy():
        data.qpos[: len(pose)] = pose
        mujoco.mj_kinematics(model, data)
        half_sizes = np.einsum(
            "gij,gj->gi", np.abs(data.geom_xmat[of_character].reshape(-1, 3, 3)), model.geom_aabb[of_character, 3:]
        )
        centres = data.geom_xpos[of_character] - data.xpos[1] * [1, 1, 0]
        between = (centres[:, 2] - half_sizes[:, 2] < high) & (centres[:, 2] + half_sizes[:, 2] > low)
        corners = (np.abs(centres) + half_sizes)[between, :2]
        radius = max(radius, float(np.hypot(*corners.T).max(initial=0.0)))
    return radius


class Weld:
    """A joint between two bodies that can be switched on and off, as live views of the state of N simulations.

    Args:
        simulation: The simulations, with ``eq_data`` among their model fields.
        name: Name of the weld, an equality constraint.

    Attributes:
        active: Whether it holds, ``(N,)``.
        pose: Position and orientation of the second body in the frame of the first at which it holds, ``(N, 7)``.
    """

    def __init__(self, simulation: Simulation, name: str) -> None:
        weld = simulation.model.equality(name).id
        self.active = simulation.state["eq_active"][:, weld]
        self.pose = simulation.state["eq_data"][:, weld, 3:10]  # after the anchor


def sensors(simulation: Simulation, beginning: str) -> Tensor:
    """Return a live view of the values of sensors that follow one another and whose names begin alike, ``(N, n)``."""
    model = simulation.model
    names = [model.sensor(sensor).name for sensor in range(model.nsensor)]
    addresses = [int(model.sensor_adr[sensor]) for sensor, name in enumerate(names) if name.startswith(beginning)]
    return simulation.outputs["sensordata"][:, addresses[0] : addresses[-1] + 1]
