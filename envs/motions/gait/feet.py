"""The motion of the feet: they stand, roll over heel and toe, and swing to the next foothold."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.gait.course import FOOTHOLD, Course, Side, between_frames
from torchrl_mcp.envs.motions.gait.curves import (
    ADVANCE,
    ASIDE,
    CLEARANCE,
    FOOT_PITCH,
    MID_STANCE,
    ROUNDING,
    TOE_OFF,
    settled,
    spline,
)
from torchrl_mcp.envs.motions.keyframes import minimum_jerk
from torchrl_mcp.envs.rotations import about_y, about_z, multiply, unit_vector

STEP_WIDTH = 0.12
CURVE_WIDTH = 0.10
SPOT_WIDTH = 0.20
"""Distance between the ankles in metres: straight ahead, in a curve, and on the spot, where the legs could cross."""

CURVED = 0.9
"""Scale of the turn rate in rad/s above which feet stand and swing as in a curve."""

TIGHT = 4.0
"""Scale of the curvature in 1/m above which feet stand as in a turn on the spot."""

CREEPING = 0.1
"""Speed in m/s that is added when computing the curvature, which is then 0 while standing."""

TOE_OUT = 0.09
"""Angle of the feet outwards, in radians."""

ARCH = 0.045
"""Distance in metres from the ankle forward to the point under the foot that carries the body."""

MEDIAL = 0.015
"""Distance in metres of that point towards the other foot."""


LONG = 0.4
SHORT = 0.08
"""Lengths of strides in metres: above the first, feet move as in normal walking; far below the second, they rest."""


class Sole(NamedTuple):
    """A foot's sole, a flat plate.

    Args:
        heel: Position of the rear edge ahead of the ankle, negative, in metres.
        toe: Position of the front edge ahead of the ankle, in metres.
        depth: Depth of the sole below the ankle, in metres.
    """

    heel: float
    toe: float
    depth: float


class Foot(NamedTuple):
    """A foot over F frames.

    Args:
        heading: Heading of the foot in radians, shape ``(F,)``.
        ankle: Position of the ankle in metres, shape ``(F, 3)``.
        orientation: Quaternion of the foot, shape ``(F, 4)``.
        support: Point of the foothold that carries the body, in metres, shape ``(F, 2)``.
        unloaded: 0 while the foot can carry the body, 1 while it swings, shape ``(F,)``.
    """

    heading: Tensor
    ankle: Tensor
    orientation: Tensor
    support: Tensor
    unloaded: Tensor


def step(course: Course, side: Side, sole: Sole) -> Foot:
    """Move one foot along the course.

    All parts of the motion shrink with the distance to the next foothold. A foot whose next foothold equals its last
    one therefore does not move: standing still is walking on the spot.

    Args:
        course: Course of the walk, F frames.
        side: Side of the foot.
        sole: Sole of the foot.
    """
    phase = _warped((course.phase - side.offset - MID_STANCE) % 1 + MID_STANCE, course.speed)
    last = course.moment(side, FOOTHOLD)
    following = course.moment(side, 1 + FOOTHOLD)
    start, start_heading = _foothold(course, side, last)
    end, end_heading = _foothold(course, side, following)
    distance = torch.linalg.vector_norm(end - start, dim=-1)
    turn = end_heading - start_heading
    vigour = settled(distance, LONG)
    stepping = settled(torch.hypot(distance, STEP_WIDTH * turn), SHORT)

    position, heading = _foothold(course, side, last + spline(ADVANCE, phase) * (following - last))
    pitch = _rolling(course, side, phase) * torch.deg2rad(spline(FOOT_PITCH, phase))
    ahead, height = rolled(pitch, sole, vigour * spline(ROUNDING, phase))
    height = height + spline(CLEARANCE, phase) * (0.4 * stepping + 0.6 * vigour)
    outward = side.sign * unit_vector(heading + torch.pi / 2)
    aside = spline(ASIDE, phase) * stepping * settled(course.turn_rate, CURVED)
    ground = position + ahead.unsqueeze(-1) * unit_vector(heading) + aside.unsqueeze(-1) * outward
    return Foot(
        heading=heading,
        ankle=torch.cat([ground, height.unsqueeze(-1)], dim=-1),
        orientation=multiply(about_z(heading), about_y(-pitch)),
        support=position + ARCH * unit_vector(heading) - MEDIAL * outward,
        unloaded=stepping * _swinging(phase),
    )


def rolled(pitch: Tensor, sole: Sole, rounding: Tensor) -> tuple[Tensor, Tensor]:
    """Roll a foot over the edge of its heel, for positive pitch, or of its toe.

    Args:
        pitch: Pitch of the foot in radians, shape ``(F,)``.
        sole: Sole of the foot.
        rounding: Pitch over which the foot passes smoothly from one edge to the other, shape ``(F,)``.

    Returns:
        Distance of the ankle ahead of its position with a flat foot, and its height above ground, each ``(F,)``.
    """
    sine, cosine = pitch.sin(), pitch.cos()
    edge = torch.where(pitch > 0, sole.heel, sole.toe)
    ahead = edge * (1 - cosine) - sole.depth * sine
    middle, half = (sole.toe + sole.heel) / 2, (sole.toe - sole.heel) / 2
    return ahead, sole.depth * cosine - middle * sine + half * torch.hypot(sine, rounding)


def _rolling(course: Course, side: Side, phase: Tensor) -> Tensor:
    """Amount of roll from 0 to 1: over the toes when the body is ahead, over the heel when the foot lands ahead."""
    last, off = (between_frames(course.balance, course.moment(side, at)) for at in (FOOTHOLD, TOE_OFF))
    strike, following = (between_frames(course.balance, course.moment(side, at)) for at in (1.0, 1 + FOOTHOLD))
    behind = settled(torch.linalg.vector_norm(off - last, dim=-1) / (TOE_OFF - FOOTHOLD), LONG)
    ahead = settled(torch.linalg.vector_norm(following - strike, dim=-1) / FOOTHOLD, LONG)
    return torch.lerp(behind, ahead, minimum_jerk((phase - TOE_OFF) / (1 - TOE_OFF)))


def _foothold(course: Course, side: Side, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Position on the ground and heading of a flat foot beside the body in some frames."""
    heading = between_frames(course.heading, frames)
    turn_rate = between_frames(course.turn_rate, frames)
    speed = between_frames(course.speed, frames)
    width = STEP_WIDTH + (CURVE_WIDTH - STEP_WIDTH) * settled(turn_rate, CURVED)
    width = width + (SPOT_WIDTH - width) * settled((turn_rate / (speed + CREEPING)) ** 2, TIGHT**2)
    beside = (side.sign * width / 2).unsqueeze(-1) * unit_vector(heading + torch.pi / 2)
    return between_frames(course.balance, frames) + beside, heading + side.sign * TOE_OUT


def _warped(phase: Tensor, speed: Tensor) -> Tensor:
    """Shift the end of stance with speed: double support falls from 0.29 at 0.8 m/s to 0.24 at 1.3 m/s."""
    double_support = (0.37 - 0.1 * speed).clamp(0.2, 0.36)
    shift = (1 + double_support) / 2 - TOE_OFF
    bump = (torch.pi * phase).sin() ** 2 / torch.sin(torch.tensor(torch.pi * TOE_OFF)) ** 2
    return torch.where(phase < 1, phase - shift * bump, phase)


def _swinging(phase: Tensor) -> Tensor:
    """Rises from 0 to 1 while the other foot takes over the load, and falls to 0 after the foot's own heel strike."""
    transfer = TOE_OFF - 0.5
    return minimum_jerk((phase - 0.5) / transfer) - minimum_jerk((phase - 1) / transfer)
