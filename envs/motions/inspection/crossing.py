"""Distance between the legs: without self-collision, nothing else shows that they pass through each other."""

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model

FURTHEST = 1.0
"""Largest distance in metres that is measured."""


def legs_apart(character: str, qpos: Tensor) -> Tensor:
    """Distance between the right and the left leg, feet included, between MuJoCo's collision shapes.

    Args:
        character: Name of a character whose legs begin at ``right_hip`` and ``left_hip``.
        qpos: States, shape ``(T, nq)``.

    Returns:
        Distances in metres, shape ``(T,)``; negative by the depth of an overlap.
    """
    model = character_model(character)
    data = mujoco.MjData(model)
    right, left = (_leg_shapes(model, side) for side in ("right", "left"))
    distances = np.empty(len(qpos))
    for frame, data.qpos in enumerate(qpos.double().numpy()):
        mujoco.mj_kinematics(model, data)
        distances[frame] = min(
            mujoco.mj_geomDistance(model, data, one, other, FURTHEST, None) for one in right for other in left
        )
    return torch.from_numpy(distances)


def _leg_shapes(model: mujoco.MjModel, side: str) -> list[int]:
    """Colliding shapes of the hip's body and its descendants."""
    bodies = {model.body(f"{side}_hip").id}
    for body in range(model.nbody):
        if model.body_parentid[body] in bodies:
            bodies.add(body)
    return [
        shape for shape in range(model.ngeom) if model.geom_bodyid[shape] in bodies and model.geom_conaffinity[shape]
    ]
