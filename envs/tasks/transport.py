"""Functions that carrying and dribbling share: places of objects, the goal, and what a return can reach."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.arguments import positive
from torchrl_mcp.envs.characters.mirror import BODY_SIGNS, VECTOR_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.observations import SIZES
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.rotations import unit_vector
from torchrl_mcp.envs.tasks.ranges import Ranges

SUCCESS_DISTANCE = 0.5
"""Distance in metres between object and target for success, as in the same authors' public code."""

SUCCESS_REACH = 2.0
"""Largest distance in metres between character and ball for success."""

ANY_DIRECTION = (-math.pi, math.pi)
"""All directions, in radians."""

POSITIONS = ("metres", "logarithmic")
"""Forms of the horizontal positions in a goal."""

LINEAR_DISTANCE = 0.25
"""Distance in metres below which logarithmic positions are nearly linear."""

LOGARITHMIC = f"horizontal vector of length ln(1 + r / {LINEAR_DISTANCE} m), r the distance"
"""Unit of a logarithmic place on the ground."""

POSITION_UNIT = f"{LOGARITHMIC}; height in m"
"""Unit of a logarithmic position of an object."""


def require_transport(*, speed: float, target_distance_power: float, goal_positions: str) -> None:
    """Check the arguments of rewards and goals.

    Raises:
        ValueError: If one is out of range.
    """
    positive(speed=speed)
    if target_distance_power not in (1, 2):
        raise ValueError(f"target_distance_power={target_distance_power} is out of range: pass 2 (paper) or 1")
    if goal_positions not in POSITIONS:
        raise ValueError(f"goal_positions={goal_positions!r} is unknown: pass {' or '.join(POSITIONS)}")


def placement(mixture: Sequence[Mapping[str, Any]], **ranges: Sequence[float]) -> Ranges:
    """Return the ranges of distances and directions of object and target.

    Raises:
        ValueError: If a range is invalid, or a distance below 0.
    """
    placed = Ranges(ranges, mixture)
    placed.require_distances("object_distances", "target_distances")
    return placed


def places(root: Tensor, drawn: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Places of object and target around a character that faces along x.

    Args:
        root: Place of the character, ``(*B, 2)``, in metres.
        drawn: Distances in metres and directions in radians of a :func:`placement`, each ``(*B)``: of the object from
            the character, and of the target from the object, counted from the direction of the object.

    Returns:
        Both places, ``(*B, 2)``.
    """
    direction = drawn["object_directions"]
    place = root + steps(drawn["object_distances"], direction)
    return place, place + steps(drawn["target_distances"], direction + drawn["target_directions"])


def steps(distances: Tensor, directions: Tensor) -> Tensor:
    """Displacements ``(*B, 2)`` from lengths in metres and directions in radians."""
    return unit_vector(directions) * distances.unsqueeze(-1)


def mocap_positions(model: mujoco.MjModel) -> Tensor:
    """Positions of a model's mocap bodies, ``(M, 3)``."""
    return torch.from_numpy(model.body_pos[model.body_mocapid >= 0])


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
    data, radius = mujoco.MjData(model), 0.0
    own = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_bodyid <= num_bodies) & (model.geom_conaffinity > 0))
    for pose in poses.cpu().numpy():
        data.qpos[: len(pose)] = pose
        mujoco.mj_kinematics(model, data)
        half_sizes = np.einsum("gij,gj->gi", np.abs(data.geom_xmat[own].reshape(-1, 3, 3)), model.geom_aabb[own, 3:])
        centres = data.geom_xpos[own] - data.xpos[1] * [1, 1, 0]
        between = (centres[:, 2] - half_sizes[:, 2] < high) & (centres[:, 2] + half_sizes[:, 2] > low)
        corners = (np.abs(centres) + half_sizes)[between, :2]
        radius = max(radius, float(np.hypot(*corners.T).max(initial=0.0)))
    return radius


def goal_of(objects: Tensor, sizes: Mapping[str, int], positions: str, *others: Tensor) -> Tensor:
    """Goal of a task with objects, laid out as :func:`goal_layout` says, ``(*B, G)``.

    Args:
        objects: What the character sees of M objects, ``(*B, M, 13)``, see :meth:`.PDCharacterEnv.see`.
        sizes: How many of these numbers the goal has of each object, by name.
        positions: Form of the horizontal positions, one of :data:`POSITIONS`.
        *others: What else the goal has, after the objects, ``(*B, F)``.
    """
    if positions == "logarithmic":
        objects = torch.cat([logarithmic(objects[..., :2]), objects[..., 2:]], -1)
    seen = [objects[..., index, :size] for index, size in enumerate(sizes.values())]
    return torch.cat([*seen, *(other.to(objects.dtype) for other in others)], -1)


def goal_layout(sizes: Mapping[str, int], waypoint: bool) -> dict[str, slice]:
    """Slices of the goal by object and quantity, from the number of entries of each object, and of the waypoint."""
    layout, start = {}, 0
    for name, shown in sizes.items():
        end = start + shown
        for quantity, size in SIZES.items():
            if start < end:
                layout[f"{name}.{quantity}"] = slice(start, start + size)
                start += size
    return {**layout, "waypoint": slice(start, start + len(VECTOR_SIGNS))} if waypoint else layout


def goal_mirror(sizes: Mapping[str, int], waypoint: bool) -> Mirror:
    """Return the reflection of a goal that exchanges left and right."""
    signs = [sign for size in sizes.values() for sign in BODY_SIGNS[:size]]
    return mirror_signs([*signs, *VECTOR_SIGNS] if waypoint else signs)


def logarithmic(positions: Tensor) -> Tensor:
    r"""Return positions of the same direction whose distance is logarithmic, ``(*B, 2)``.

    .. math:: x \mapsto \frac{x}{|x|} \ln\left(1 + \frac{|x|}{d}\right), \quad d = 0.25 \text{ m}

    Directions are as easy to tell near an object as far from it.

    Args:
        positions: Positions x in metres, shape ``(*B, 2)``.
    """
    distances = torch.linalg.vector_norm(positions, dim=-1, keepdim=True)
    return torch.nn.functional.normalize(positions, dim=-1) * torch.log1p(distances / LINEAR_DISTANCE)


def near(place: Tensor, target: Tensor, distance: float) -> Tensor:
    """Whether positions ``(*B, D)`` are horizontally less than ``distance`` metres apart, ``(*B)``, bool."""
    return torch.linalg.vector_norm((place - target)[..., :2], dim=-1) < distance


def pointers(com: Tensor, place: Tensor, target: Tensor) -> list[Arrow]:
    """Arrows from above a character to an object, and from above the object to its target, ``(3,)`` each in metres."""
    return [_pointer(com, place), _pointer(place, target)]


def _pointer(tail: Tensor, tip: Tensor) -> Arrow:
    """A horizontal arrow above ``tail``, towards ``tip`` and at most 1 m long."""
    tail, tip = tail.double().cpu(), tip.double().cpu()
    way = (tip - tail) * torch.tensor([1.0, 1.0, 0.0])
    start = tail + torch.tensor([0.0, 0.0, 0.8])
    return start.numpy(), (start + way / way.norm().clamp_min(1.0)).numpy()
