"""Indices of a character's joints in MuJoCo's ``qpos`` and ``qvel``."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.mirror import REFLECTION, Sides, twin


@cache
def character_model(character: str) -> mujoco.MjModel:
    """Compile a character alone, without floor; the result is shared and must not be changed.

    Raises:
        ValueError: If there is no such character.
    """
    if character not in CHARACTERS:
        raise ValueError(f"character={character!r} does not exist: pass one of {sorted(CHARACTERS)}")
    return CHARACTERS[character].spec().compile()


@dataclass(frozen=True, eq=False)
class JointLayout:
    """A character's joints by name, and their indices in a state.

    Args:
        names: Joints in the order of the bodies, the free joint of the root first.
        nq: Length of ``qpos``.
        nv: Length of ``qvel``.
        quaternions: Indices in ``qpos`` of the quaternions, the root's first, shape ``(Q, 4)``, int64.
        spins: Indices in ``qvel`` of their angular velocities, shape ``(Q, 3)``, int64.
        angles: Indices in ``qpos`` of the hinges, shape ``(H,)``, int64.
        rates: Indices in ``qvel`` of their velocities, shape ``(H,)``, int64.
        mirror: Index in ``qpos`` of the number that replaces each number in the mirror image, shape ``(nq,)``, int64.
        mirror_sign: Sign of each number in the mirror image, shape ``(nq,)``, float64.
    """

    names: tuple[str, ...]
    nq: int
    nv: int
    quaternions: Tensor
    spins: Tensor
    angles: Tensor
    rates: Tensor
    mirror: Tensor
    mirror_sign: Tensor

    def to(self, device: torch.device) -> "JointLayout":
        """Return the layout with its indices on a device."""
        moved: dict[str, Any] = {
            key: value.to(device) for key, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **moved)


@cache
def joint_layout(character: str) -> JointLayout:
    """Read the layout of a character from its model."""
    model = character_model(character)
    names = tuple(model.joint(index).name for index in range(model.njnt))
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    offsets = torch.from_numpy((model.jnt_type == mujoco.mjtJoint.mjJNT_FREE) * 3)[~hinges]
    positions = torch.from_numpy(model.jnt_qposadr).long()
    velocities = torch.from_numpy(model.jnt_dofadr).long()
    mirror, mirror_sign = _mirror(model, names, CHARACTERS[character].sides)
    return JointLayout(
        names=names,
        nq=model.nq,
        nv=model.nv,
        quaternions=(positions[~hinges] + offsets).unsqueeze(-1) + torch.arange(4),
        spins=(velocities[~hinges] + offsets).unsqueeze(-1) + torch.arange(3),
        angles=positions[hinges],
        rates=velocities[hinges],
        mirror=mirror,
        mirror_sign=mirror_sign,
    )


def _mirror(model: mujoco.MjModel, names: tuple[str, ...], sides: Sides) -> tuple[Tensor, Tensor]:
    """Reflect y: a position changes y; a rotation, a pseudo-vector, changes x and z; left and right are exchanged.

    A joint without a twin stays where it is: such a character has no mirror images.
    """
    source = torch.empty(model.nq, dtype=torch.int64)
    sign = torch.ones(model.nq, dtype=torch.float64)
    for joint, name in enumerate(names):
        other = names.index(twin(name, sides)) if twin(name, sides) in names else joint
        here, there = model.jnt_qposadr[joint], model.jnt_qposadr[other]
        match model.jnt_type[joint]:
            case mujoco.mjtJoint.mjJNT_FREE:
                signs = [1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0]
            case mujoco.mjtJoint.mjJNT_BALL:
                signs = [1.0, -1.0, 1.0, -1.0]
            case _:
                signs = [-float(model.jnt_axis[joint] @ REFLECTION @ model.jnt_axis[other])]  # axes are pseudo-vectors
        source[here : here + len(signs)] = torch.arange(there, there + len(signs))
        sign[here : here + len(signs)] = torch.tensor(signs, dtype=torch.float64).round()
    return source, sign
