"""Falls: which shapes of a character must not touch the ground, and how low they are."""

from typing import TypeVar

import mujoco
import numpy as np
import torch
from torch import Tensor

Numbers = TypeVar("Numbers", Tensor, np.ndarray)


def falling_geoms(model: mujoco.MjModel, feet: tuple[str, ...], num_bodies: int) -> tuple[Tensor, Tensor, Tensor]:
    """The geoms that must not touch the ground: colliding geoms of all bodies except the feet.

    Returns:
        Their ids ``(G,)``, half-sizes ``(G, 3)`` and radii ``(G,)`` for :func:`lowest_points`.
    """
    owners = torch.tensor(model.geom_bodyid)
    others = torch.tensor([model.body(body).id for body in feet])
    collides = torch.tensor(model.geom_contype | model.geom_conaffinity) != 0
    ids = ((owners > 0) & (owners <= num_bodies) & collides & ~torch.isin(owners, others)).nonzero().squeeze(-1)
    kinds = [mujoco.mjtGeom(kind) for kind in model.geom_type[ids.numpy()]]
    half_sizes = torch.zeros(len(ids), 3, dtype=torch.float64)
    radii = torch.zeros(len(ids), dtype=torch.float64)
    for row, (kind, size) in enumerate(zip(kinds, torch.tensor(model.geom_size[ids.numpy()]), strict=True)):
        match kind:
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                radii[row] = size[0]
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                radii[row] = size[0]
                half_sizes[row, 2] = size[1]
            case mujoco.mjtGeom.mjGEOM_BOX:
                half_sizes[row] = size
            case _:
                raise ValueError(f"a character has a colliding {kind.name}: use spheres, capsules and boxes")
    return ids, half_sizes, radii


def lowest_points(heights: Numbers, vertical: Numbers, half_sizes: Numbers, radii: Numbers) -> Numbers:
    r"""Height of the lowest point of spheres, capsules and boxes.

    .. math:: z - r - \sum_i |R_{3i}| h_i

    Each is the set of points within a radius :math:`r` of a box of half-sizes :math:`h`, turned by :math:`R`. For a
    sphere the box is a point, for a capsule a line, and for a box the radius is 0.

    Args:
        heights: Heights z of the centres in metres, shape ``(*B, G)``.
        vertical: Last row of each rotation matrix, shape ``(*B, G, 3)``.
        half_sizes: Half-sizes h in metres, shape ``(G, 3)``.
        radii: Radii r in metres, shape ``(G,)``.

    Returns:
        Heights, shape ``(*B, G)``, in metres.
    """
    return heights - radii - (abs(vertical) * half_sizes).sum(-1)
