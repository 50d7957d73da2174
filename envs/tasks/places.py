"""Places on the ground, and how a character sees them."""

import math

import torch
from torch import Tensor

from torchrl_mcp.envs.rotations import unit_vector

ANY_DIRECTION = (-math.pi, math.pi)
"""All directions, in radians."""

LINEAR_DISTANCE = 0.25
"""Distance in metres below which logarithmic positions are nearly linear."""

LOGARITHMIC = f"horizontal vector of length ln(1 + r / {LINEAR_DISTANCE} m), r the distance"
"""Unit of a logarithmic place on the ground."""


def steps(distances: Tensor, directions: Tensor) -> Tensor:
    """Displacements ``(*B, 2)`` from lengths in metres and directions in radians."""
    return unit_vector(directions) * distances.unsqueeze(-1)


def near(place: Tensor, target: Tensor, distance: float) -> Tensor:
    """Whether positions ``(*B, D)`` are horizontally less than ``distance`` metres apart, ``(*B)``, bool."""
    return torch.linalg.vector_norm((place - target)[..., :2], dim=-1) < distance


def logarithmic(positions: Tensor) -> Tensor:
    r"""Return positions of the same direction whose distance is logarithmic, ``(*B, 2)``.

    .. math:: x \mapsto \frac{x}{|x|} \ln\left(1 + \frac{|x|}{d}\right), \quad d = 0.25 \text{ m}

    Directions are as easy to tell near an object as far from it.

    Args:
        positions: Positions x in metres, shape ``(*B, 2)``.
    """
    distances = torch.linalg.vector_norm(positions, dim=-1, keepdim=True)
    return torch.nn.functional.normalize(positions, dim=-1) * torch.log1p(distances / LINEAR_DISTANCE)
