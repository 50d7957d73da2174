"""How far the legs are apart: without self-collision nothing else says that they pass through each other."""

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.motions.joints import character_model

FURTHEST = 1.0
"""Metres beyond which distances are not measured."""


def legs_apart(character: str, qpos: Tensor) -> Tensor:
    """Distance between the right and the left leg, feet included, by MuJoCo's own collision shapes.

    Args:
        character: Name of a character whose legs begin at ``right_hip`` and ``left_hip``.
        qpos: States, shape ``(T, nq)``.

    Returns:
        Metres, shape ``(T,)``; negative by the depth to which the legs are in each other.
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
    """Shapes that collide, of the hip's body and of all that hangs on it."""
    bodies = {model.body(f"{side}_hip").id}
    for body in range(model.nbody):
        if model.body_parentid[body] in bodies:
            bodies.add(body)
    return [
        shape for shape in range(model.ngeom) if model.geom_bodyid[shape] in bodies and model.geom_conaffinity[shape]
    ]
