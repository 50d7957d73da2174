"""A clip in six numbers."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.contacts import support
from torchrl_mcp.envs.motions.soles import FLAT, soles
from torchrl_mcp.envs.rotations import heading

SWINGING = 1.0
"""Speed in m/s above which a foot is in the air."""

RUNNING = 2.0
"""Speed in m/s above which people run; both feet of a runner are in the air when they pass each other."""

SPINNING = 3.0
"""Rate of turning in rad/s above which a foot pivots or slips; people who walk turn more slowly."""

STEPS, LOOPED_STEPS = 3, 2
"""Fewest steps of a walk, and of one cycle of a walk."""

NEAR = 0.05
"""Height in metres of a sole above or below the ground up to which the foot should stand."""

GRAVITY = 9.81

SLIDING = 0.2
"""Speed in m/s above which :func:`foot_slide` is only if a motion is read incorrectly."""

GLIDING = 0.7
"""The same for :func:`gliding`."""


class Summary(NamedTuple):
    """Summary of a clip.

    Attributes:
        duration: Duration in seconds, or of one cycle if it loops.
        speed: Mean horizontal speed of the root, in m/s.
        turn_rate: Mean absolute rate of the root's heading, in rad/s.
        slide: See :func:`foot_slide`, in m/s.
        sole: Median height of standing soles above the ground, in metres; NaN if no foot stands.
        gliding: See :func:`gliding`, in m/s.
    """

    duration: float
    speed: float
    turn_rate: float
    slide: float
    sole: float
    gliding: float


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
        sole=soles(clip).standing_height(),
        gliding=gliding(clip),
    )


def foot_slide(clip: MotionClip) -> float:
    """Median horizontal speed of a foot while the other one swings past it, in m/s; NaN without walking on two feet.

    At that moment the foot should stand. If the rotations of a recording are read in the wrong order, it slides at 0.2
    to 1 m/s. Moments without a foot on the ground, as in jumps, rolls, cartwheels and crawls, and in which the body
    runs or spins, are left out.
    """
    names = body_names(clip.character)
    bodies = body_states(clip.character, clip.qpos, clip.qvel)
    feet = [names.index(foot) for foot in CHARACTERS[clip.character].feet[:2]]
    if len(feet) < 2:
        return math.nan
    velocities = bodies.linear_velocities[..., :2]
    places = bodies.positions[..., :2]
    first, second = feet
    swinging = (velocities[:, first] - velocities[:, second]).norm(dim=-1) > SWINGING
    turning = bodies.angular_velocities[:, 0, 2].abs()
    walking = swinging & (velocities[:, 0].norm(dim=-1) < RUNNING) & (turning < SPINNING)
    apart = (places[:, first] - places[:, second]).norm(dim=-1)
    passing = (apart[1:-1] < apart[:-2]) & (apart[1:-1] <= apart[2:]) & walking[1:-1]
    speed, slower = velocities[:, feet].norm(dim=-1).min(-1)
    on_ground = _on_ground(clip).gather(1, slower.unsqueeze(-1)).squeeze(-1)
    slides = speed[1:-1][passing & on_ground[1:-1]]
    return float(slides.quantile(0.5)) if len(slides) >= (LOOPED_STEPS if clip.loop else STEPS) else math.nan


def gliding(clip: MotionClip) -> float:
    """Median speed of the slowest of the lowest points of the body, in m/s; NaN if it falls or runs all the time.

    While it does neither, something should rest on the ground, whatever the motion: feet, knees, hands, or the back. If
    the rotations of a recording are read in the wrong order, so that the body tumbles, everything glides at 1 m/s.
    """
    model = character_model(clip.character)
    states = body_states(clip.character, clip.qpos, clip.qvel)
    masses = torch.from_numpy(model.body_mass[1:] / model.body_mass[1:].sum())
    (acceleration,) = torch.gradient(states.linear_velocities[..., 2] @ masses, spacing=1 / clip.fps)
    carried = (acceleration > -GRAVITY / 2) & (states.linear_velocities[:, 0, :2].norm(dim=-1) < RUNNING)
    speeds = support(clip.character, states).speeds[carried]
    return float(speeds.median()) if len(speeds) else math.nan


def _on_ground(clip: MotionClip) -> Tensor:
    """Whether each foot is close to the ground and not far from level, shape ``(T, F)``, bool."""
    feet = soles(clip)
    return (feet.heights.abs() < NEAR) & (feet.tilts < 2 * FLAT)
