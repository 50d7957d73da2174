"""The observation of a character's own state, as functions of arrays.

They run right after the physics, which evicts the caches; there an operation takes NumPy a third of torch's time. On
the CPU they therefore use arrays, on other devices tensors, stored by component with the simulations side by side:
``(L, 13, n)``.
"""

import math
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.kinematics import BodyStates
from torchrl_mcp.envs.physics.arrays import Array, as_array, as_tensor, by_component, contiguous

SIZES = {"position": 3, "orientation": 4, "linear_velocity": 3, "angular_velocity": 3}
"""Quantities observed of a body, in this order, with their sizes: 13 numbers."""

UNITS = {
    "root_height": "m",
    "position": "m",
    "orientation": "quaternion w x y z",
    "linear_velocity": "m/s",
    "angular_velocity": "rad/s",
}
"""Units of the quantities of a character's state."""


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
    return _rows(_flat(_seen(angle, origin, bodies)), angle)


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
    height = as_array(root[..., 2].reshape(1, -1))
    return _rows(_arrays(angle).concatenate([height, _flat(_seen(angle, root, bodies))]), angle)


def _seen(angle: Tensor, origin: Tensor, bodies: BodyStates) -> Array:
    """Return :func:`bodies_in_heading_frame` by component, ``(L, 13, n)``."""
    arrays = _arrays(angle)
    positions, orientations, linear, angular = (_planes(field) for field in bodies)
    positions = positions - as_array(origin).reshape(1, -1, 3).swapaxes(1, 2)
    x, y = _turned(arrays.stack([vectors[:, :2] for vectors in (positions, linear, angular)]), angle.reshape(-1))
    # A quaternion turns by half the angle, in (w, z) and in (x, y).
    quaternions = _turned(arrays.stack([orientations[:, ::3], orientations[:, 1:3]]), angle.reshape(-1) / 2)
    sign = arrays.copysign(arrays.ones_like(quaternions[0][0]), quaternions[0][0])
    (qw, qx), (qz, qy) = (part * sign for part in quaternions)
    place, velocity, spin = ((x[i], y[i], field[:, 2]) for i, field in enumerate((positions, linear, angular)))
    return arrays.stack([*place, qw, qx, qy, qz, *velocity, *spin], 1)


def _turned(pairs: Array, angle: Tensor) -> tuple[Array, Array]:
    r"""Turn pairs of components by :math:`-\psi`.

    .. math:: (a, b) \mapsto (a \cos\psi + b \sin\psi, \; b \cos\psi - a \sin\psi)

    Args:
        pairs: Pairs of L bodies, shape ``(P, L, 2, n)``.
        angle: :math:`\psi` of each simulation in radians, shape ``(n,)``.

    Returns:
        Both components, ``(P, L, n)``.
    """
    cos, sin = as_array(angle.cos()), as_array(angle.sin())
    one, other = pairs[:, :, 0], pairs[:, :, 1]
    return one * cos + other * sin, other * cos - one * sin


def _arrays(tensor: Tensor) -> ModuleType:
    """The module whose functions take what :func:`as_array` returns."""
    return np if tensor.is_cpu else torch


def _planes(field: Tensor) -> Array:
    """A view of L vectors for each of n simulations, shape ``(*B, L, C)``, as ``(L, C, n)``."""
    array = as_array(field)
    return by_component(array.reshape(math.prod(array.shape[:-2]), *array.shape[-2:]))


def _flat(seen: Array) -> Array:
    """Numbers of all bodies, from ``(L, 13, n)`` to ``(13 L, n)``."""
    return seen.reshape(seen.shape[0] * seen.shape[1], seen.shape[-1])


def _rows(seen: Array, angle: Tensor) -> Tensor:
    """An array of n simulations, ``(D, n)``, as a tensor ``(*B, D)``."""
    return as_tensor(contiguous(seen.T)).reshape(*angle.shape, len(seen))


def state_layout(bodies: list[str]) -> dict[str, slice]:
    """Slices of :func:`character_state`, by body and quantity."""
    return {"root_height": slice(0, 1), **bodies_layout(bodies, start=1)}


def bodies_layout(bodies: list[str], *, start: int = 0) -> dict[str, slice]:
    """Slices of :func:`bodies_in_heading_frame`, by body and quantity.

    Args:
        bodies: Names of the bodies.
        start: Index of the first number.
    """
    layout = {}
    for body in bodies:
        for quantity, size in SIZES.items():
            layout[f"{body}.{quantity}"] = slice(start, start + size)
            start += size
    return layout
