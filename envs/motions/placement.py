"""Rigid motions of the ground plane, which move a motion to another position and heading."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.rotations import about_z, heading, multiply


class Placement(NamedTuple):
    r"""A turn about the vertical through the origin, then a shift: :math:`p \mapsto R_z(\psi) p + s`.

    Args:
        turn: Angle :math:`\psi`, shape ``(*B)``, in radians.
        shift: Horizontal displacement :math:`s`, shape ``(*B, 2)``, in metres.
    """

    turn: Tensor
    shift: Tensor

    def vectors(self, vectors: Tensor) -> Tensor:
        """Turn directions or velocities, shape ``(*B, 3)``."""
        cosine, sine = self.turn.cos(), self.turn.sin()
        x, y, z = torch.broadcast_tensors(*vectors.unbind(-1), cosine)[:3]
        return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z]).movedim(0, -1)

    def points(self, points: Tensor) -> Tensor:
        """Turn and shift points, shape ``(*B, 3)``."""
        turned = self.vectors(points)
        return torch.cat([turned[..., :2] + self.shift, turned[..., 2:]], dim=-1)

    def quaternions(self, quaternions: Tensor) -> Tensor:
        """Turn orientations, shape ``(*B, 4)``."""
        return multiply(about_z(self.turn), quaternions)

    def qpos(self, qpos: Tensor) -> Tensor:
        """Move states of a character, shape ``(*B, nq)``: the root moves, the joints stay the same."""
        return torch.cat([self.points(qpos[..., :3]), self.quaternions(qpos[..., 3:7]), qpos[..., 7:]], dim=-1)

    def qvel(self, qvel: Tensor) -> Tensor:
        """Turn velocities of a character, shape ``(*B, nv)``: only the root's linear velocity is in the world."""
        return torch.cat([self.vectors(qvel[..., :3]), qvel[..., 3:]], dim=-1)

    def after(self, first: "Placement") -> "Placement":
        """Return the composition of ``first`` and then this placement."""
        shift = torch.cat([first.shift, torch.zeros_like(first.shift[..., :1])], dim=-1)
        return Placement(self.turn + first.turn, self.points(shift)[..., :2])

    def inverse(self) -> "Placement":
        """Return the inverse placement."""
        back = Placement(-self.turn, torch.zeros_like(self.shift))
        shift = torch.cat([-self.shift, torch.zeros_like(self.shift[..., :1])], dim=-1)
        return Placement(-self.turn, back.points(shift)[..., :2])

    def power(self, times: Tensor) -> "Placement":
        r"""Return the placement applied k times, k an integer of either sign, shape ``(*B)``.

        .. math:: \sum_{j<k} R_z(j \psi) s = \frac{\sin (k \psi / 2)}{\sin (\psi / 2)} R_z(\tfrac{k - 1}{2} \psi) s
        """
        half = self.turn / (2 * torch.pi)
        length = times * torch.sinc(times * half) / torch.sinc(half)
        direction = (times - 1) / 2 * self.turn
        cosine, sine = length * direction.cos(), length * direction.sin()
        x, y = self.shift.unbind(-1)
        return Placement(times * self.turn, torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1))


def placing(start: Tensor, end: Tensor) -> Placement:
    """Return the placement from one horizontal root position and heading to another, with an angle in (-pi, pi].

    Args:
        start: Root position and quaternion before, shape ``(*B, >= 7)``, such as states ``qpos``.
        end: Root position and quaternion after, shape ``(*B, >= 7)``.
    """
    angle = heading(end[..., 3:7]) - heading(start[..., 3:7])
    turn = torch.atan2(angle.sin(), angle.cos())
    return Placement(
        turn, end[..., :2] - Placement(turn, torch.zeros_like(end[..., :2])).points(start[..., :3])[..., :2]
    )
