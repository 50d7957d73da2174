"""Points at which bodies can touch the ground."""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.contract import colliding_bodies
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import BodyStates, body_names
from torchrl_mcp.envs.rotations import rotate

LAYER = 0.03
"""Height in metres above the lowest point of a body up to which other points may touch the ground, too."""


class ContactPoints(NamedTuple):
    """Points of a body over time: corners of boxes, and undersides of spheres and of the ends of capsules.

    Args:
        positions: Positions in the world, shape ``(T, P, 3)``, in metres.
        velocities: Velocities of the body at these points, shape ``(T, P, 3)``, in m/s.
        offsets: Positions in the body's frame, at the centres of round shapes, shape ``(P, 3)``.
    """

    positions: Tensor
    velocities: Tensor
    offsets: Tensor


class Support(NamedTuple):
    """What may carry a character over time.

    Attributes:
        heights: Height of its lowest contact point, shape ``(T,)``, in metres.
        speeds: Speed of the slowest contact point at most :data:`LAYER` above the lowest, shape ``(T,)``, in m/s.
        bodies: Name of the body that has the lowest point, in each frame.
    """

    heights: Tensor
    speeds: Tensor
    bodies: list[str]


def support(character: str, states: BodyStates) -> Support:
    """Return the lowest contact point of all bodies that can collide, and the slowest near it, in T frames."""
    names = sorted(colliding_bodies(character_model(character)))
    points = [contact_points(character, name, states) for name in names]
    owners = [index for index, point in enumerate(points) for _ in point.offsets]
    heights = torch.cat([point.positions[..., 2] for point in points], dim=1)
    speeds = torch.cat([point.velocities.norm(dim=-1) for point in points], dim=1)
    height, lowest = heights.min(-1, keepdim=True)
    slowest = speeds.where(heights <= height + LAYER, torch.inf).amin(-1)
    return Support(height.squeeze(-1), slowest, [names[owners[index]] for index in lowest.squeeze(-1).tolist()])


def contact_points(character: str, body: str, states: BodyStates) -> ContactPoints:
    """Return the contact points of one body, of its shapes that can collide.

    Args:
        character: Name of the character.
        body: Name of the body.
        states: States of all bodies, from :func:`~torchrl_mcp.envs.characters.kinematics.body_states`, T frames.

    Raises:
        ValueError: If none of its shapes can collide.
    """
    offsets, radii = _outline(character_model(character), body)
    index = body_names(character).index(body)
    orientation = states.orientations[:, index].unsqueeze(1)
    arms = rotate(orientation, offsets)
    arms = torch.cat([arms[..., :2], arms[..., 2:] - radii.unsqueeze(-1)], dim=-1)
    spin = states.angular_velocities[:, index].unsqueeze(1).expand_as(arms)
    return ContactPoints(
        positions=states.positions[:, index].unsqueeze(1) + arms,
        velocities=states.linear_velocities[:, index].unsqueeze(1) + torch.linalg.cross(spin, arms),
        offsets=offsets,
    )


def _outline(model: mujoco.MjModel, body: str) -> tuple[Tensor, Tensor]:
    """Points ``(P, 3)`` in the frame of a body, and the radii ``(P,)`` of round shapes about them."""
    points = []
    radii = []
    owner = model.body(body)
    for index in range(owner.geomadr[0], owner.geomadr[0] + owner.geomnum[0]):
        geom = model.geom(index)
        if not (geom.contype[0] or geom.conaffinity[0]):
            continue  # decoration
        size = geom.size
        match geom.type[0]:
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                local = np.zeros((1, 3))
                radius = size[0]
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                local = np.array([[0, 0, -size[1]], [0, 0, size[1]]])
                radius = size[0]
            case _:
                local = size * np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(8, 3)
                radius = 0.0
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, geom.quat)
        points.append(geom.pos + local @ matrix.reshape(3, 3).T)
        radii.append(np.full(len(local), radius))
    if not points:
        raise ValueError(f"{body} has no shape that collides: draw one, or name other feet")
    return torch.from_numpy(np.concatenate(points)), torch.from_numpy(np.concatenate(radii))
