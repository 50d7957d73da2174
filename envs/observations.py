"""The observation of a character's own state, as functions of tensors."""

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.kinematics import BodyStates


def into_heading_frame(angle: Tensor, vectors: Tensor) -> Tensor:
    """Turn vectors by ``-angle`` about z.

    Args:
        angle: Heading in radians, shape ``(*B)``.
        vectors: In world coordinates, shape ``(*B, M, 3)``.
    """
    # Component by component, here and below, which is twice as fast as small matrices.
    cos, sin = angle.cos().unsqueeze(-1), angle.sin().unsqueeze(-1)
    x, y, z = vectors.unbind(-1)
    return torch.stack([cos * x + sin * y, cos * y - sin * x, z], -1)


def orientations_in_heading_frame(angle: Tensor, orientations: Tensor) -> Tensor:
    """Turn orientations by ``-angle`` about z, with the sign that makes w positive: q and -q are the same rotation.

    Args:
        angle: Heading in radians, shape ``(*B)``.
        orientations: Unit quaternions (w, x, y, z), shape ``(*B, M, 4)``.
    """
    cos, sin = (angle / 2).cos().unsqueeze(-1), (angle / 2).sin().unsqueeze(-1)
    w, x, y, z = orientations.unbind(-1)
    sign = torch.where(cos * w + sin * z < 0, -1.0, 1.0).to(cos.dtype)
    cos, sin = sign * cos, sign * sin
    return torch.stack([cos * w + sin * z, cos * x + sin * y, cos * y - sin * x, cos * z - sin * w], -1)


def bodies_in_heading_frame(angle: Tensor, origin: Tensor, bodies: BodyStates) -> Tensor:
    """Bodies as seen from a place and a heading: position, orientation, linear and angular velocity of each.

    Args:
        angle: Heading in radians, shape ``(*B)``.
        origin: The place, shape ``(*B, 3)``, in metres.
        bodies: L bodies in world coordinates, each ``(*B, L, ...)``.

    Returns:
        Shape ``(*B, 13 L)``.
    """
    vectors = [bodies.positions - origin.unsqueeze(-2), bodies.linear_velocities, bodies.angular_velocities]
    relative, linear, angular = into_heading_frame(angle, torch.cat(vectors, -2)).chunk(3, -2)
    orientations = orientations_in_heading_frame(angle, bodies.orientations)
    return torch.cat([relative, orientations, linear, angular], -1).flatten(-2)


def character_state(angle: Tensor, bodies: BodyStates) -> Tensor:
    """State s of a character: all its bodies as seen from the root, whatever its place and heading in the world.

    The height of the root, then for every body its position relative to the root, its orientation, its linear and its
    angular velocity, in the frame that moves with the root and turns with its heading. See :func:`state_layout`.

    Args:
        angle: The root's heading in radians, shape ``(*B)``.
        bodies: The L bodies in world coordinates, the root first, each ``(*B, L, ...)``.

    Returns:
        Shape ``(*B, 1 + 13 L)``.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        section 5.1 and table 3, https://arxiv.org/abs/1905.09808
    """
    root = bodies.positions[..., 0, :]
    return torch.cat([root[..., 2:], bodies_in_heading_frame(angle, root, bodies)], -1)


def state_layout(bodies: list[str]) -> dict[str, slice]:
    """Where to find each quantity in :func:`character_state`, by the names of the bodies."""
    sizes = {"position": 3, "orientation": 4, "linear_velocity": 3, "angular_velocity": 3}
    layout, start = {"root_height": slice(0, 1)}, 1
    for body in bodies:
        for quantity, size in sizes.items():
            layout[f"{body}.{quantity}"] = slice(start, start + size)
            start += size
    return layout
