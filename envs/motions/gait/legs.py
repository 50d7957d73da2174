"""Height of the pelvis over the feet, and inverse kinematics of the legs."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import conv1d, max_pool1d, pad, softplus

from torchrl_mcp.envs.motions.gait.course import SIDES, Course, Side, between_frames
from torchrl_mcp.envs.motions.gait.curves import spline
from torchrl_mcp.envs.motions.gait.feet import Foot
from torchrl_mcp.envs.rotations import about_x, about_y, about_z, inverse, multiply, rotate

KNEE_KEYS = ((-0.005, 6.0), (0.12, 18.5), (0.30, 6.5))
"""Phases of a leg's stance with the flexion of its knee in degrees: heel strike, loading, body over the foot."""

TRAILING_KEYS = (12.0, 42.0, 0.0)
"""Least flexion of the other knee at these phases, in degrees."""

STANDING_KNEE = 6.0
LEAST_KNEE = 5.0
"""Flexions in degrees: when standing, and the least flexion, which the pelvis is lowered to keep."""

SOFTNESS = 0.002
"""Width in metres of the smooth minimum of two heights."""

RELIEF = 0.16
"""Half the time in seconds over which the pelvis is lowered for a leg that would be overstretched."""

OUTWARD = 0.7
"""Share of the angle between pelvis and foot that the hip turns; the ankle turns the rest."""

INWARD = 0.1
"""Largest inward turn of the hip in radians; the ankle turns the rest, because otherwise the knees would cross."""


class Leg(NamedTuple):
    """A leg's bones.

    Args:
        thigh: Length of the thigh in metres.
        shank: Length of the shank in metres.
        hip: Position of the left hip relative to the root, shape ``(3,)``.
    """

    thigh: float
    shank: float
    hip: Tensor

    def hip_offset(self, side: Side, pelvis: Tensor) -> Tensor:
        """Vector from the root to a hip in the world, ``(F, 3)``, for orientations of the pelvis ``(F, 4)``."""
        return rotate(pelvis, self.hip * torch.tensor([1.0, side.sign, 1.0]))

    def length(self, flexion: Tensor) -> Tensor:
        """Distance from hip to ankle by the law of cosines, for flexions of the knee in radians."""
        return (self.thigh**2 + self.shank**2 + 2 * self.thigh * self.shank * flexion.cos()).sqrt()


def pelvis_height(
    course: Course, leg: Leg, pelvis: Tensor, position: Tensor, feet: Mapping[Side, Foot], activity: Tensor
) -> Tensor:
    """Height of the root, shape ``(F,)``, that results in the knee flexions of walking.

    A spline runs through the heights that the loaded leg needs at three moments of each stance. If a leg would then be
    overstretched, as in a sudden turn, the pelvis is lowered.

    Args:
        course: Course of the walk.
        leg: Bones of a leg.
        pelvis: Orientation of the pelvis, shape ``(F, 4)``.
        position: Horizontal position of the root, shape ``(F, 2)``.
        feet: Foot of each side.
        activity: From 0, standing, to 1, walking, shape ``(F,)``.
    """
    keys = []
    for side, other in zip(SIDES, reversed(SIDES), strict=True):
        for (phase, flexion), least in zip(KNEE_KEYS, TRAILING_KEYS, strict=True):
            asked = _height_over(leg, side, pelvis, position, feet[side], activity, flexion)
            allowed = _height_over(leg, other, pelvis, position, feet[other], activity, least)
            frames = _moments(course, side.offset + phase)
            keys.append(torch.stack([frames, between_frames(_lower(asked, allowed), frames)], dim=-1))
    heights = torch.cat(keys)
    height = spline(heights[heights[:, 0].argsort()], torch.arange(len(position), dtype=position.dtype))
    return height - _relief(leg, pelvis, torch.cat([position, height.unsqueeze(-1)], dim=-1), feet, course.fps)


def leg_joints(leg: Leg, side: Side, pelvis: Tensor, root: Tensor, foot: Foot, forward: Tensor) -> tuple[Tensor, ...]:
    """Solve a leg between hip and ankle, in a vertical plane whose heading is between those of pelvis and foot.

    Args:
        leg: Bones of a leg.
        side: Side of the leg.
        pelvis: Orientation of the pelvis, shape ``(F, 4)``.
        root: Position of the root, shape ``(F, 3)``.
        foot: Foot of that side.
        forward: Heading of the pelvis without its swing, shape ``(F,)``.

    Returns:
        Orientation of the thigh relative to the pelvis, ``(F, 4)``, flexion of the knee in radians, ``(F,)``, and
        orientation of the foot relative to the shank, ``(F, 4)``.
    """
    line = root + leg.hip_offset(side, pelvis) - foot.ankle
    length = torch.linalg.vector_norm(line, dim=-1)
    outward = softplus(side.sign * (foot.heading - forward) + INWARD, beta=1 / INWARD) - INWARD
    heading = forward + OUTWARD * side.sign * outward
    x, y, z = (rotate(about_z(-heading), line) / length.unsqueeze(-1)).unbind(-1)
    limb = multiply(about_z(heading), multiply(about_y(torch.atan2(x, z)), about_x(-y.asin())))
    length = length.clamp_max(float(leg.length(torch.deg2rad(torch.tensor(1.0)))))
    hip = torch.acos((leg.thigh**2 + length**2 - leg.shank**2) / (2 * leg.thigh * length))
    ankle = torch.acos((leg.shank**2 + length**2 - leg.thigh**2) / (2 * leg.shank * length))
    thigh = multiply(limb, about_y(-hip))
    shank = multiply(limb, about_y(ankle))
    return multiply(inverse(pelvis), thigh), hip + ankle, multiply(inverse(shank), foot.orientation)


def _height_over(
    leg: Leg, side: Side, pelvis: Tensor, position: Tensor, foot: Foot, activity: Tensor, flexion: float
) -> Tensor:
    """Height of the root for a flexion of the leg's knee (in degrees, when walking), shape ``(F,)``."""
    hip = leg.hip_offset(side, pelvis)
    away = position + hip[:, :2] - foot.ankle[:, :2]
    length = leg.length(torch.deg2rad(STANDING_KNEE + activity * (flexion - STANDING_KNEE)))
    rise = (length.square() - away.square().sum(-1)).clamp_min(0.01).sqrt()
    return foot.ankle[:, 2] + rise - hip[:, 2]


def _relief(leg: Leg, pelvis: Tensor, root: Tensor, feet: Mapping[Side, Foot], fps: float) -> Tensor:
    """Smooth lowering of the pelvis in metres so that no leg is overstretched, shape ``(F,)``."""
    limit = leg.length(torch.deg2rad(root.new_tensor(LEAST_KNEE)))
    excess = torch.zeros_like(root[:, 2])
    for side, foot in feet.items():
        line = root + leg.hip_offset(side, pelvis) - foot.ankle
        length = torch.linalg.vector_norm(line, dim=-1)
        excess = torch.maximum(excess, (length - limit) * length / line[:, 2])
    half = round(RELIEF * fps)
    window = torch.hann_window(2 * half + 3, periodic=False, dtype=excess.dtype)[1:-1]
    widest = max_pool1d(excess.view(1, 1, -1), 2 * half + 1, stride=1, padding=half)
    return conv1d(pad(widest, (half, half), mode="replicate"), (window / window.sum()).view(1, 1, -1)).flatten()


def _moments(course: Course, phase: float) -> Tensor:
    """All frames at which a phase of the stride is reached."""
    first, last = float(course.phase[0]) - phase, float(course.phase[-1]) - phase
    return course.frame_at(torch.arange(math.ceil(first), math.floor(last) + 1, dtype=torch.float64) + phase)


def _lower(a: Tensor, b: Tensor) -> Tensor:
    """Smooth minimum."""
    return -SOFTNESS * torch.logaddexp(-a / SOFTNESS, -b / SOFTNESS)
