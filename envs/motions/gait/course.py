"""The course of a walk: where it leads, when the feet step, and where they stand so that the body stays in balance."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.gait.curves import MID_STANCE

GRAVITY = 9.81

FOOTHOLD = 0.27
"""Phase of its stride at which the body passes a foothold."""


@dataclass(frozen=True, eq=False)
class Course:
    r"""A path over the ground, walked at a given speed and turn rate, in F frames.

    The centre of mass is taken for an inverted pendulum of constant height h: with acceleration :math:`\ddot x` it is
    in balance over the point :math:`z = x - \frac{h}{g} \ddot x`, outside of the path in a turn and behind it when
    speeding up. Footholds lie to both sides of that point.

    Args:
        fps: Frames per second.
        speed: Shape ``(F,)``, in m/s.
        turn_rate: Shape ``(F,)``, in rad/s, positive to the left.
        heading: Direction of the path, shape ``(F,)``, in radians.
        balance: The points z, shape ``(F, 2)``, in metres.
        phase: Strides walked; the right heel strikes at whole numbers, the left halfway. Shape ``(F,)``.
    """

    fps: float
    speed: Tensor
    turn_rate: Tensor
    heading: Tensor
    balance: Tensor
    phase: Tensor

    @property
    def forward(self) -> Tensor:
        """Unit vectors along the path, shape ``(F, 2)``."""
        return direction(self.heading)

    @property
    def lean(self) -> Tensor:
        """Angle to the left, shape ``(F,)``, at which a turn's centrifugal force and gravity are in balance."""
        return torch.atan(self.speed * self.turn_rate / GRAVITY)

    def frame_at(self, phase: Tensor) -> Tensor:
        """When each phase is reached: frames counted from 0, not whole, of the same shape."""
        after = torch.searchsorted(self.phase, phase.contiguous()).clamp(1, len(self.phase) - 1)
        before = self.phase[after - 1]
        return after - 1 + (phase - before) / (self.phase[after] - before)

    def moment(self, side: "Side", phase: float) -> Tensor:
        """For every frame, the frame in which a phase of the foot's cycle that goes on is reached, shape ``(F,)``."""
        return self.frame_at((self.phase - side.offset - MID_STANCE).floor() + side.offset + phase)


@dataclass(frozen=True)
class Side:
    """A side of the body.

    Args:
        name: ``"right"`` or ``"left"``, with which the names of its bodies begin.
        sign: Of y there.
        offset: Phase at which its heel strikes.
    """

    name: str
    sign: float
    offset: float


SIDES = (Side("right", -1.0, 0.0), Side("left", 1.0, 0.5))


def plan(speed: Tensor, turn_rate: Tensor, fps: float, height: float, start: int = 0) -> Course:
    """Lay out a course that is at the origin in frame ``start``, along x, with the right heel striking.

    Args:
        speed: Shape ``(F,)``, in m/s.
        turn_rate: Shape ``(F,)``, in rad/s.
        fps: Frames per second.
        height: Of the centre of mass, in metres.
        start: A frame.
    """
    heading = accumulated(turn_rate, fps, start)
    forward, left = direction(heading), direction(heading + torch.pi / 2)
    path = accumulated(speed.unsqueeze(-1) * forward, fps, start)
    along, across = torch.gradient(speed, spacing=1 / fps)[0], speed * turn_rate
    acceleration = along.unsqueeze(-1) * forward + across.unsqueeze(-1) * left
    balance = path - height / GRAVITY * acceleration
    return Course(fps, speed, turn_rate, heading, balance, accumulated(stride_rate(speed, turn_rate), fps, start))


def stride_rate(speed: Tensor, turn_rate: Tensor) -> Tensor:
    """Strides per second: 0.42 + 0.44 v, as measured at 0.7 to 1.5 m/s.

    Who walks more slowly makes shorter steps rather than slower ones, and who turns sharply makes quicker ones.
    """
    return 0.42 + 0.44 * speed + 0.25 * torch.exp(-((speed / 0.35) ** 2)) + 0.03 * turn_rate**2 + 0.006 * turn_rate**4


def direction(angle: Tensor) -> Tensor:
    """Unit vectors ``(*B, 2)`` at angles of shape ``(*B)``."""
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def accumulated(rate: Tensor, fps: float, start: int) -> Tensor:
    """Integrate over the frames, the first dimension, by the trapezoidal rule from 0 in frame ``start``."""
    total = torch.cat([torch.zeros_like(rate[:1]), ((rate[1:] + rate[:-1]) / (2 * fps)).cumsum(0)])
    return total - total[start]


def between_frames(values: Tensor, frames: Tensor) -> Tensor:
    """Read frames that are not whole by Catmull and Rom's cubic, which is smooth where lines would have corners.

    Args:
        values: Shape ``(F)`` or ``(F, D)``.
        frames: Shape ``(*B)``.
    """
    whole = frames.floor().clamp(1, len(values) - 3).long()
    u = (frames - whole).view(*frames.shape, *[1] * (values.ndim - 1))
    a, b, c, d = (values[whole + step] for step in (-1, 0, 1, 2))
    return b + u / 2 * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))
