"""A clip in four numbers."""

from typing import NamedTuple

import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.rotations import heading

SWINGING = 1.0
"""Speed in m/s above which a foot is in the air."""

RUNNING = 2.0
"""Speed in m/s above which people run; both feet of a runner are in the air when they pass each other."""


class Summary(NamedTuple):
    """Summary of a clip.

    Attributes:
        duration: Duration in seconds, or of one cycle if it loops.
        speed: Mean horizontal speed of the root, in m/s.
        turn_rate: Mean absolute rate of the root's heading, in rad/s.
        slide: See :func:`foot_slide`, in m/s.
    """

    duration: float
    speed: float
    turn_rate: float
    slide: float


def summarised(clip: MotionClip) -> Summary:
    """Summarise a clip of a character."""
    steps = clip.qpos[:, :2].diff(dim=0).norm(dim=-1)
    turns = heading(clip.qpos[:, 3:7]).diff()
    turns = torch.atan2(turns.sin(), turns.cos()).abs()
    return Summary(
        duration=clip.duration,
        speed=float(steps.mean() * clip.fps),
        turn_rate=float(turns.mean() * clip.fps),
        slide=foot_slide(clip),
    )


def foot_slide(clip: MotionClip) -> float:
    """Median horizontal speed of an ankle while the other one swings past it, in m/s; NaN without walking on two feet.

    At that moment the foot should stand. If the rotations of a recording are read in the wrong order, it slides at 0.2
    to 1 m/s.
    """
    names, bodies = body_names(clip.character), body_states(clip.character, clip.qpos, clip.qvel)
    feet = [names.index(foot) for foot in CHARACTERS[clip.character].feet]
    if len(feet) < 2:
        return float("nan")
    speeds = bodies.linear_velocities[:, feet, :2].norm(dim=-1)
    apart = (bodies.positions[:, feet[0], :2] - bodies.positions[:, feet[1], :2]).norm(dim=-1)
    walking = (speeds.amax(-1) > SWINGING) & (bodies.linear_velocities[:, 0, :2].norm(dim=-1) < RUNNING)
    passing = (apart[1:-1] < apart[:-2]) & (apart[1:-1] <= apart[2:]) & walking[1:-1]
    slides = speeds[1:-1][passing].amin(-1)
    return float(slides.quantile(0.5)) if len(slides) else float("nan")
