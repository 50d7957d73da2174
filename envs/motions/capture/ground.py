"""The ground of a recorded motion: where feet stand, or else where other parts of the body rest."""

import math
from collections import Counter
from itertools import compress

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool1d

from torchrl_mcp.envs.characters.kinematics import body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.contacts import support
from torchrl_mcp.envs.motions.keyframes import smoothed
from torchrl_mcp.envs.motions.soles import Soles, soles

FPS = 60.0
"""Frames per second at which speeds are measured, as the noise of faster recordings would hide who is still."""

LASTING = 7
"""Frames for which a foot stands at least; at the top of a jump it is still for a shorter time."""

LEVELS = 0.05
"""Difference in metres between the heights of standing feet beyond which the ground of a recording is not flat."""

SINKING = 0.4
"""Vertical speed in m/s up to which a foot may stand on ground that rises or sinks."""

WINDOW = 0.5
"""Length in seconds of the window that smooths the height of such ground."""

RESTING = 0.3
"""Speed in m/s up to which a point of the body may rest on the ground."""


def grounded(character: str, qpos: Tensor, times: Tensor, *, loop: bool = False) -> tuple[Tensor, str]:
    """Shift a motion to begin at x = y = 0, with the soles of standing feet at the height 0 in the median.

    If no foot stands, the lowest points of the body that rest are put at the height 0 instead; if none rests, the
    lowest point of the body is below the ground in a fiftieth of the frames. If feet stand at different heights, as on
    stairs or where sensors drift, the height of the ground below them is subtracted, unless the motion is a loop.

    Args:
        character: Name of the character.
        qpos: States, shape ``(T, nq)``.
        times: Their times in seconds, increasing from 0, shape ``(T,)``.
        loop: Whether the motion repeats.

    Returns:
        The states, and what was assumed other than that feet stand on flat ground, as a sentence; or nothing.

    Raises:
        ValueError: If a foot has no shape that collides.
    """
    shift = torch.cat([qpos[0, :2], torch.zeros(1, dtype=torch.float64)])
    qpos = torch.cat([qpos[:, :3] - shift, qpos[:, 3:]], dim=-1)
    clip = _evenly(character, qpos, times)
    note = ""
    level = None if loop else _level(soles(clip, sinking=SINKING))
    if level is not None:
        note = f"feet stand at heights up to {100 * float(level.max() - level.min()):.0f} cm apart, which were levelled"
        even = torch.arange(len(level), dtype=torch.float64) / clip.fps
        qpos = _lowered(qpos, torch.from_numpy(np.interp(times.numpy(), even.numpy(), level.numpy())))
        clip = _evenly(character, qpos, times)
    floor = soles(clip).standing_height()
    if math.isnan(floor):
        floor, note = _resting(clip)
    return _lowered(qpos, torch.full_like(times, floor)), note


def _evenly(character: str, qpos: Tensor, times: Tensor) -> MotionClip:
    """Return states at equal distances in time."""
    duration = float(times[-1])
    steps = max(1, round(duration * FPS))
    frames = np.interp(np.linspace(0, duration, steps + 1), times.numpy(), np.arange(len(times)))
    return MotionClip(character, MotionClip(character, qpos, fps=1.0).at(torch.from_numpy(frames)), steps / duration)


def _lowered(qpos: Tensor, height: Tensor) -> Tensor:
    """Move states ``(T, nq)`` down by a height of each frame, ``(T,)``."""
    return torch.cat([qpos[:, :2], qpos[:, 2:3] - height.unsqueeze(-1), qpos[:, 3:]], dim=-1)


def _level(feet: Soles) -> Tensor | None:
    """Height of the ground below standing feet in every frame, ``(T,)``; None if it is flat."""
    stands = _lasting(feet.stands.any(-1))
    if not stands.any():
        return None
    heights = feet.heights.where(feet.stands, torch.inf).amin(-1)[stands]
    low, high = heights.quantile(heights.new_tensor([0.05, 0.95])).tolist()
    if high - low < LEVELS:
        return None
    frames = stands.nonzero().squeeze(-1)
    ground = np.interp(np.arange(len(stands)), frames.numpy(), heights.numpy())
    return smoothed(torch.from_numpy(ground), FPS, WINDOW)


def _lasting(stands: Tensor) -> Tensor:
    """Frames within :data:`LASTING` or more in which something holds, shape ``(T,)``, bool."""
    middles = ~_around(~stands)
    return _around(middles)


def _around(frames: Tensor) -> Tensor:
    """Frames at most half of :data:`LASTING` away from the given ones, shape ``(T,)``, bool."""
    return max_pool1d(frames.double()[None], LASTING, stride=1, padding=LASTING // 2)[0].bool()


def _resting(clip: MotionClip) -> tuple[float, str]:
    """Height of the ground of a body on which no foot stands, and what was taken for it."""
    heights, speeds, bodies = support(clip.character, body_states(clip.character, clip.qpos, clip.qvel))
    resting = speeds < RESTING
    if not resting.any():
        return float(heights.quantile(0.02)), "no part of the body rests: the ground is at its lowest points"
    resting_bodies = Counter(compress(bodies, resting.tolist()))
    named = ", ".join(body for body, _ in resting_bodies.most_common(3))
    return float(heights[resting].median()), f"no foot stands flat: the ground is where {named} rest"
