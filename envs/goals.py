"""Goals of carrying and dribbling: the layout of their entries, and the form of the positions."""

from collections.abc import Mapping

import torch
from torch import Tensor

POSITIONS = ("metres", "logarithmic")
"""Forms of the horizontal positions in a goal."""

LINEAR_DISTANCE = 0.25
"""Distance in metres below which logarithmic positions are nearly linear."""


def goal_layout(things: Mapping[str, int]) -> dict[str, slice]:
    """Slices of the goal by body and quantity, from the number of entries of each body."""
    sizes = {"position": 3, "orientation": 4, "linear_velocity": 3, "angular_velocity": 3}
    layout, start = {}, 0
    for thing, shown in things.items():
        end = start + shown
        for quantity, size in sizes.items():
            if start < end:
                layout[f"{thing}.{quantity}"] = slice(start, start + size)
                start += size
    return layout


def logarithmic(positions: Tensor) -> Tensor:
    r"""Return positions of the same direction whose distance is logarithmic, ``(*B, 2)``.

    .. math:: x \mapsto \frac{x}{|x|} \ln\left(1 + \frac{|x|}{d}\right), \quad d = 0.25 \text{ m}

    Directions are as easy to tell near an object as far from it.

    Args:
        positions: Positions x in metres, shape ``(*B, 2)``.
    """
    distances = torch.linalg.vector_norm(positions, dim=-1, keepdim=True)
    return torch.nn.functional.normalize(positions, dim=-1) * torch.log1p(distances / LINEAR_DISTANCE)
