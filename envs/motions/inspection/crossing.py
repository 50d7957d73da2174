"""Distance between the legs: without self-collision, nothing else shows that they pass through each other."""

from itertools import combinations, product

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.contract import line_of
from torchrl_mcp.envs.characters.joints import character_model

FURTHEST = 1.0
"""Largest distance in metres that is measured."""


def legs_apart(character: str, qpos: Tensor) -> Tensor:
    """Distance between any two legs, feet included, between MuJoCo's collision shapes.

    Args:
        character: Name of a character with two feet or more.
        qpos: States, shape ``(T, nq)``.

    Returns:
        Distances in metres, shape ``(T,)``; negative by the depth of an overlap.
    """
    model = character_model(character)
    data = mujoco.MjData(model)
    feet = [model.body(foot).id for foot in CHARACTERS[character].feet]
    pairs = [
        pair
        for one, other in combinations(feet, 2)
        for pair in product(_leg_shapes(model, one, other), _leg_shapes(model, other, one))
    ]
    distances = np.empty(len(qpos))
    for frame, data.qpos in enumerate(qpos.double().numpy()):
        mujoco.mj_kinematics(model, data)
        distances[frame] = min(
            (mujoco.mj_geomDistance(model, data, one, other, FURTHEST, None) for one, other in pairs), default=FURTHEST
        )
    return torch.from_numpy(distances)


def _leg_shapes(model: mujoco.MjModel, foot: int, other: int) -> list[int]:
    """Colliding shapes of the leg of a foot: all that hangs on the first body that does not carry another foot."""
    trunk = line_of(model, other)
    leg = reversed(line_of(model, foot))
    bodies = {next(body for body in leg if body not in trunk)} if foot not in trunk else set()
    for body in range(model.nbody):
        if model.body_parentid[body] in bodies:
            bodies.add(body)
    return [
        shape for shape in range(model.ngeom) if model.geom_bodyid[shape] in bodies and model.geom_conaffinity[shape]
    ]
