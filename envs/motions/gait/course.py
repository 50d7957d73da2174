"""The course of a walk: its path, the timing of steps, and footholds that keep the body in balance."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.gait.curves import MID_STANCE
from torchrl_mcp.envs.rotations import unit_vector

GRAVITY = 9.81

FOOTHOLD = 0.27
"""Phase of a foot's stride at which the body passes its foothold."""


@dataclass(frozen=True, eq=False)
class Course:
    r"""A path over the ground, walked at a given speed and turn rate, in F frames.

    The centre of mass is modelled as an inverted pendulum of constant height h: with acceleration :math:`\ddot x` it is
    in balance over the point :math:`z = x - \frac{h}{g} \ddot x`, outside the path in a turn and behind it when
    speeding up. Footholds lie on both sides of that point.

    Args:
        fps: Frames per second.
        speed: Speed in m/s, shape ``(F,)``.
        turn_rate: Turn rate in rad/s, positive to the left, shape ``(F,)``.
        heading: Direction of the path in radians, shape ``(F,)``.
        balance: The points z in metres, shape ``(F, 2)``.
        phase: Strides walked, shape ``(F,)``; the right heel strikes at whole numbers, the left halfway between.
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
        return unit_vector(self.heading)

    @property
    def lean(self) -> Tensor:
        """Lean to the left that balances a turn's centrifugal force and gravity, in radians, shape ``(F,)``."""
        return torch.atan(self.speed * self.turn_rate / GRAVITY)

    def frame_at(self, phase: Tensor) -> Tensor:
        """Fractional frames, counted from 0, at which phases are reached, of the same shape."""
        after = torch.searchsorted(self.phase, phase.contiguous()).clamp(1, len(self.phase) - 1)
        before = self.phase[after - 1]
        return after - 1 + (phase - before) / (self.phase[after] - before)

    def moment(self, side: "Side", phase: float) -> Tensor:
        """For every frame, the frame at which the current cycle of the foot reaches a phase, shape ``(F,)``."""
        return self.frame_at((self.phase - side.offset - MID_STANCE).floor() + side.offset + phase)


@dataclass(frozen=True)
class Side:
    """A side of the body.

    Args:
        name: ``"right"`` or ``"left"``, the prefix of the names of its bodies.
        sign: Sign of y on this side.
        offset: Phase at which the heel strikes.
    """

    name: str
    sign: float
    offset: float


SIDES = (Side("right", -1.0, 0.0), Side("left", 1.0, 0.5))


def plan(speed: Tensor, turn_rate: Tensor, fps: float, height: float, start: int = 0) -> Course:
    """Plan a course that passes the origin along x in frame ``start``, when the right heel strikes.

    Args:
        speed: Speed in m/s, shape ``(F,)``.
        turn_rate: Turn rate in rad/s, shape ``(F,)``.
        fps: Frames per second.
        height: Height of the centre of mass, in metres.
        start: Frame at the origin.
    """
    heading = accumulated(turn_rate, fps, start)
    forward = unit_vector(heading)
    left = unit_vector(heading + torch.pi / 2)
    path = accumulated(speed.unsqueeze(-1) * forward, fps, start)
    along = torch.gradient(speed, spacing=1 / fps)[0]
    across = speed * turn_rate
    acceleration = along.unsqueeze(-1) * forward + across.unsqueeze(-1) * left
    balance = path - height / GRAVITY * acceleration
    return Course(fps, speed, turn_rate, heading, balance, accumulated(stride_rate(speed, turn_rate), fps, start))


def stride_rate(speed: Tensor, turn_rate: Tensor) -> Tensor:
    """Strides per second: 0.42 + 0.44 v, as measured at 0.7 to 1.5 m/s.

    Below that, steps become shorter rather than slower; in sharp turns they become quicker.
    """
    return 0.42 + 0.44 * speed + 0.25 * torch.exp(-((speed / 0.35) ** 2)) + 0.03 * turn_rate**2 + 0.006 * turn_rate**4


def accumulated(rate: Tensor, fps: float, start: int) -> Tensor:
    """Integrate over the frames, the first dimension, by the trapezoidal rule from 0 in frame ``start``."""
    total = torch.cat([torch.zeros_like(rate[:1]), ((rate[1:] + rate[:-1]) / (2 * fps)).cumsum(0)])
    return total - total[start]


def between_frames(values: Tensor, frames: Tensor) -> Tensor:
    """Interpolate at fractional frames by Catmull and Rom's cubic, which has no corners.

    Args:
        values: Values at whole frames, shape ``(F)`` or ``(F, D)``.
        frames: Fractional frames, shape ``(*B)``.
    """
    whole = frames.floor().clamp(1, len(values) - 3).long()
    u = (frames - whole).view(*frames.shape, *[1] * (values.ndim - 1))
    a, b, c, d = (values[whole + step] for step in (-1, 0, 1, 2))
    return b + u / 2 * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))
