"""The observation of a character's own state, as functions of arrays.

They run right after the physics, which evicts the caches; there an operation takes NumPy a third of torch's time. On
the CPU they therefore use arrays, stored by component with the simulations side by side: ``(L, 13, n)``.
"""

import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.kinematics import BodyStates
from torchrl_mcp.envs.rotations import about_z, multiply, rotate

SIZES = {"position": 3, "orientation": 4, "linear_velocity": 3, "angular_velocity": 3}
"""Quantities observed of a body, in this order, with their sizes: 13 numbers."""

_TURNS = np.array([1.0, 1.0, 1.0, 0.5, 0.5], np.float32).reshape(5, 1, 1, 1)
"""Factors on the heading by which pairs of components turn: those of three vectors, and two of a quaternion."""


def bodies_in_heading_frame(angle: Tensor, origin: Tensor, bodies: BodyStates) -> Tensor:
    """Position, orientation, linear and angular velocity of bodies, in the frame of an origin and a heading.

    An orientation is the quaternion with positive w.

    Args:
        angle: Heading in radians, shape ``(*B)``.
        origin: Origin of the frame, shape ``(*B, 3)``, in metres.
        bodies: L bodies in world coordinates, each ``(*B, L, ...)``.

    Returns:
        Shape ``(*B, 13 L)``.
    """
    if not angle.is_cpu:
        return _elsewhere(angle, origin, bodies)
    seen = _seen(angle, origin, bodies)
    return _rows(seen.reshape(-1, seen.shape[-1]), angle)


def character_state(angle: Tensor, bodies: BodyStates) -> Tensor:
    """State s of a character, which does not depend on its place and heading in the world.

    It has the height of the root, then for every body the position relative to the root, orientation, linear and
    angular velocity, in the frame of the root's position and heading. See :func:`state_layout`.

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
    if not angle.is_cpu:
        return torch.cat([root[..., 2:], _elsewhere(angle, root, bodies)], -1)
    seen = _seen(angle, root, bodies)
    height = root[..., 2].reshape(1, -1).numpy()
    return _rows(np.concatenate([height, seen.reshape(-1, seen.shape[-1])]), angle)


def _seen(angle: Tensor, origin: Tensor, bodies: BodyStates) -> np.ndarray:
    r"""Return :func:`bodies_in_heading_frame` as an array, ``(L, 13, n)``.

    A turn by :math:`-\psi` about z takes a pair of components :math:`(a, b)` to :math:`(a \cos + b \sin, b \cos - a
    \sin)`: of a vector (x, y) by :math:`\psi`, of a quaternion (w, z) and (x, y) by :math:`\psi / 2`.
    """
    positions, orientations, linear, angular = (_planes(field) for field in bodies)
    place = origin.numpy().reshape(1, -1, 3).swapaxes(1, 2)
    pairs = np.empty((5, 2, *positions[:, 0].shape), positions.dtype)
    np.subtract(_pair(positions), _pair(place), out=pairs[0])
    pairs[1], pairs[2] = _pair(linear), _pair(angular)
    pairs[3], pairs[4] = orientations[:, ::3].swapaxes(0, 1), orientations[:, 1:3].swapaxes(0, 1)
    turns = torch.from_numpy(angle.numpy().reshape(-1) * _TURNS)
    across = pairs[:, ::-1] * turns.sin().numpy()
    pairs *= turns.cos().numpy()
    pairs[:, 0] += across[:, 0]
    pairs[:, 1] -= across[:, 1]
    pairs[3:] *= np.copysign(1, pairs[3, 0])
    seen = np.empty((len(positions), 13, positions.shape[-1]), positions.dtype)
    for pair, rows in zip(pairs, (slice(0, 2), slice(7, 9), slice(10, 12), slice(3, 7, 3), slice(4, 6)), strict=True):
        seen[:, rows] = pair.swapaxes(0, 1)
    np.subtract(positions[:, 2], place[:, 2], out=seen[:, 2])
    seen[:, 9], seen[:, 12] = linear[:, 2], angular[:, 2]
    return seen


def _elsewhere(angle: Tensor, origin: Tensor, bodies: BodyStates) -> Tensor:
    """Return :func:`bodies_in_heading_frame` on other devices than the CPU."""
    turn = about_z(-angle).unsqueeze(-2)
    orientations = multiply(turn, bodies.orientations)
    parts = [
        rotate(turn, bodies.positions - origin.unsqueeze(-2)),
        torch.where(orientations[..., :1] < 0, -orientations, orientations),
        rotate(turn, bodies.linear_velocities),
        rotate(turn, bodies.angular_velocities),
    ]
    return torch.cat(parts, -1).flatten(-2)


def _planes(field: Tensor) -> np.ndarray:
    """A view of L vectors for each of n simulations, shape ``(*B, L, C)``, as ``(L, C, n)``."""
    array = field.numpy()
    return array.reshape(-1, *array.shape[-2:]).transpose(1, 2, 0)


def _pair(vectors: np.ndarray) -> np.ndarray:
    """Components x and y of vectors, ``(L, 3, n)``, as ``(2, L, n)``."""
    return vectors[:, :2].swapaxes(0, 1)


def _rows(seen: np.ndarray, angle: Tensor) -> Tensor:
    """An array of n simulations, ``(D, n)``, as a tensor ``(*B, D)``."""
    return torch.from_numpy(np.ascontiguousarray(seen.T)).reshape(*angle.shape, len(seen))


def state_layout(bodies: list[str]) -> dict[str, slice]:
    """Slices of :func:`character_state`, by body and quantity."""
    layout, start = {"root_height": slice(0, 1)}, 1
    for body in bodies:
        for quantity, size in SIZES.items():
            layout[f"{body}.{quantity}"] = slice(start, start + size)
            start += size
    return layout
