"""Mirror images of a character's observations and actions, with left and right exchanged."""

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor, nn

from torchrl_mcp.envs.characters.sides import SIDES, Sides, twin

BODY_SIGNS = (1, -1, 1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1)
"""Signs of a body's observation: a vector changes y; a rotation or spin, a pseudo-vector, changes x and z."""

VECTOR_SIGNS = (1, -1)
"""Signs of a horizontal vector."""


class Mirror(nn.Module):
    """A reflection of features, as a permutation with signs. It is its own inverse.

    Args:
        sources: Index of the feature that replaces each feature, ``F`` of them.
        signs: Sign of each feature after the permutation.

    Example:
        >>> left_right_up = Mirror([1, 0, 2], [1, 1, -1])
        >>> left_right_up(torch.tensor([1.0, 2.0, 3.0]))
        tensor([ 2.,  1., -3.])
    """

    sources: Tensor
    signs: Tensor

    def __init__(self, sources: Sequence[int], signs: Sequence[float]) -> None:
        super().__init__()
        self.register_buffer("sources", torch.as_tensor(sources), persistent=False)
        self.register_buffer("signs", torch.as_tensor(signs, dtype=torch.float32), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the mirror image of ``x``, shape ``(*B, F)``."""
        return x[..., self.sources] * self.signs


def mirror_signs(signs: Sequence[float]) -> Mirror:
    """Return the reflection that changes signs only."""
    return Mirror(range(len(signs)), signs)


def mirror_bodies(names: Sequence[str], *, repeats: int = 1, sides: Sides = SIDES) -> Mirror:
    """Return the reflection of :func:`~torchrl_mcp.envs.observations.bodies_in_heading_frame`.

    Args:
        names: Names of the bodies.
        repeats: Number of consecutive observations of all bodies.
        sides: Beginnings or ends of names, right and left.
    """
    size = len(BODY_SIGNS)
    twins = [names.index(twin(name, sides)) for name in names]
    once = [size * body + entry for body in twins for entry in range(size)]
    sources = [len(once) * time + source for time in range(repeats) for source in once]
    return Mirror(sources, list(BODY_SIGNS) * len(names) * repeats)


def mirror_state(names: Sequence[str], *, sides: Sides = SIDES) -> Mirror:
    """Return the reflection of a :func:`~torchrl_mcp.envs.observations.character_state` of the bodies ``names``."""
    bodies = mirror_bodies(names, sides=sides)
    return Mirror([0, *(1 + bodies.sources).tolist()], [1.0, *bodies.signs.tolist()])


def mirror_actions(model: mujoco.MjModel, *, sides: Sides = SIDES) -> Mirror:
    """Return the reflection of a character's controls, which are rotation targets with the same scale on both sides."""
    names = [model.actuator(index).name for index in range(model.nu)]
    axes = torch.tensor([_axis(model, index) for index in range(model.nu)])
    joints = [model.joint(index).name for index in model.actuator_trnid[:, 0]]
    sources = torch.tensor(
        [names.index(twin(joint, sides) + name.removeprefix(joint)) for joint, name in zip(joints, names, strict=True)]
    )
    signs = (axes * axes[sources] * torch.tensor([-1.0, 1.0, -1.0])).sum(-1).round()
    return Mirror(sources.tolist(), signs.tolist())


def _axis(model: mujoco.MjModel, actuator: int) -> list[float]:
    """Rotation axis of an actuator in the rest pose."""
    joint = model.actuator_trnid[actuator, 0]
    hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    axis: list[float] = (model.jnt_axis[joint] if hinge else model.actuator_gear[actuator, :3]).tolist()
    return axis
