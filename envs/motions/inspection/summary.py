"""A clip in four numbers."""

from typing import NamedTuple

import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.kinematics import body_names, body_states
from torchrl_mcp.envs.rotations import heading

SWINGING = 1.0
"""m/s. A foot that moves faster is in the air."""

RUNNING = 2.0
"""m/s. Nobody walks faster; runners pass their feet in the air."""


class Summary(NamedTuple):
    """What a clip is like.

    Attributes:
        duration: Seconds, of one cycle where it loops.
        speed: Mean horizontal speed of the root, in m/s.
        turn_rate: Mean absolute rate of the root's heading, in rad/s.
        slide: See :func:`foot_slide`, in m/s.
    """

    duration: float
    speed: float
    turn_rate: float
    slide: float


def summarised(clip: MotionClip) -> Summary:
    """Sum up a clip of a character with two feet."""
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
    """Median horizontal speed of an ankle while the other one swings past it, in m/s; NaN if nobody walks.

    At that moment the foot should stand. A recording whose rotations are read in a wrong order slides at 0.2 to 1 m/s.
    """
    names, bodies = body_names(clip.character), body_states(clip.character, clip.qpos, clip.qvel)
    feet = [names.index(foot) for foot in CHARACTERS[clip.character].feet]
    speeds = bodies.linear_velocities[:, feet, :2].norm(dim=-1)
    apart = (bodies.positions[:, feet[0], :2] - bodies.positions[:, feet[1], :2]).norm(dim=-1)
    walking = (speeds.amax(-1) > SWINGING) & (bodies.linear_velocities[:, 0, :2].norm(dim=-1) < RUNNING)
    passing = (apart[1:-1] < apart[:-2]) & (apart[1:-1] <= apart[2:]) & walking[1:-1]
    slides = speeds[1:-1][passing].amin(-1)
    return float(slides.quantile(0.5)) if len(slides) else float("nan")
