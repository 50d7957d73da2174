"""Positions and velocities of a character's bodies, by MuJoCo's forward kinematics."""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.physics.arrays import Array


class BodyStates(NamedTuple):
    """The L bodies of a character, the root first, in world coordinates.

    Args:
        positions: Positions of the bodies' origins, shape ``(*B, L, 3)``, in metres.
        orientations: Unit quaternions (w, x, y, z), shape ``(*B, L, 4)``.
        linear_velocities: Velocities of the bodies' origins, shape ``(*B, L, 3)``, in m/s.
        angular_velocities: Angular velocities, shape ``(*B, L, 3)``, in rad/s.
    """

    positions: Tensor
    orientations: Tensor
    linear_velocities: Tensor
    angular_velocities: Tensor


def body_names(character: str) -> list[str]:
    """Names of a character's bodies, the root first."""
    model = character_model(character)
    return [model.body(index).name for index in range(1, model.nbody)]


def body_states(character: str, qpos: Tensor, qvel: Tensor) -> BodyStates:
    """Positions and velocities of all bodies in each of T states.

    Args:
        character: Name of the character.
        qpos: Positions in MuJoCo's convention, shape ``(T, nq)``.
        qvel: Velocities in MuJoCo's convention, shape ``(T, nv)``.
    """
    model = character_model(character)
    data = mujoco.MjData(model)
    frames = len(qpos)
    positions = np.empty((frames, model.nbody, 3))
    orientations = np.empty((frames, model.nbody, 4))
    twists = np.empty((frames, model.nbody, 6))
    centres = np.empty((frames, 1, 3))
    for frame, (data.qpos, data.qvel) in enumerate(zip(qpos.numpy(), qvel.numpy(), strict=True)):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        positions[frame] = data.xpos
        orientations[frame] = data.xquat
        twists[frame] = data.cvel
        centres[frame] = data.subtree_com[1]
    angular, linear, arms = (field.swapaxes(1, 2) for field in (twists[..., :3], twists[..., 3:], positions - centres))
    linear = origin_velocities(angular, linear, arms).swapaxes(1, 2)
    return BodyStates(*(torch.from_numpy(field[:, 1:]) for field in (positions, orientations, linear, twists[..., :3])))


def origin_velocities(angular: Array, linear: Array, arms: Array) -> Array:
    r"""Velocities of bodies' origins from MuJoCo's ``cvel``, stored by component.

    .. math:: v = v_c + \omega \times (x - x_c)

    where :math:`v_c` is the velocity of the body at the point of the centre of mass :math:`x_c` of its tree.

    Args:
        angular: :math:`\omega`, shape ``(L, 3, n)``, in rad/s.
        linear: :math:`v_c`, shape ``(L, 3, n)``, in m/s.
        arms: :math:`x - x_c`, shape ``(L, 3, n)``, in metres.

    Returns:
        Shape ``(L, 3, n)``, in m/s.
    """
    if isinstance(angular, Tensor):  # on a device, lists of indices would wait for the processor
        return torch.linalg.cross(angular, arms, dim=1) + linear
    across = angular[:, [1, 2, 0]] * arms[:, [2, 0, 1]] - angular[:, [2, 0, 1]] * arms[:, [1, 2, 0]]
    return across + linear
