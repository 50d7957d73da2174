"""The generated walks of the project: random, with the speeds and turns of people walking about."""

import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import FPS, stride, walk
from torchrl_mcp.envs.motions.keyframes import minimum_jerk, smoothed

WALKS = 7
DURATION = 16.4
"""Number of walks and their seconds: 229.6 s with mirror images, as much as the paper's corpus."""

TURN_RATE_QUANTILES = ((0.0, 0.0), (0.12, 0.14), (0.5, 0.52), (0.9, 1.36), (0.95, 1.6), (0.985, 3.1), (1.0, 3.2))
"""Quantiles of the absolute turn rate in rad/s. After smoothing they match the paper's corpus: half of the time above
0.50, 5 % above 1.61, 1 % above 2.92."""

SPEED_QUANTILES = ((0.0, 0.35), (0.05, 0.48), (0.5, 0.97), (0.95, 1.46), (1.0, 1.55))
"""Quantiles of the speed in m/s. After smoothing, with stops, 95, 50 and 5 % of speeds exceed 0.38, 0.92 and 1.42."""

SMOOTHING = 0.8
"""Length in seconds of the Hann window that smooths sudden turns."""

SLOWING = 0.25
"""Mean loss of speed in m/s per rad/s of turn rate."""

SPREAD = 0.25
"""Standard deviation in m/s of speeds at equal turn rates."""

CHANGE = 3.0
"""Time scale in seconds of changes of speed and turn rate."""

STOPS = ((1, 8.0), (4, 6.0))
"""Walks in which the character stands still, and the times in seconds."""

STOP = 0.8
HALT = 2.0
"""Seconds of standing, and of slowing down before it and speeding up after it."""

TURNING_SPEEDS = (("forward", 1.0, 0.0), ("slight", 1.05, 0.4), ("medium", 0.95, 0.8), ("sharp", 0.8, 1.4))


def walking_corpus(character: str, seed: int) -> dict[str, MotionClip]:
    """Generate 229.6 s of walking: seven walks and their mirror images, by name.

    Speed and turn rate vary smoothly. Over the corpus they are distributed as in the paper's corpus, which is mostly
    curved walking near 1 m/s. Two of the walks come to a stop and go on.

    Args:
        character: ``"humanoid"`` or ``"biped"``.
        seed: Seed of the random walks.
    """
    speeds, turn_rates = _wandering(seed)
    clips = {}
    for index, (speed, turn_rate) in enumerate(zip(speeds, turn_rates, strict=True), start=1):
        clips[f"walk_{index}"] = clip = walk(character, speed, turn_rate)
        clips[f"walk_{index}_mirrored"] = clip.mirrored()
    return clips


def turning_clips(character: str) -> dict[str, MotionClip]:
    """Generate seven looping walks with constant speed and turn rate: straight ahead, and three turns to each side."""
    clips: dict[str, MotionClip] = {}
    for name, speed, turn_rate in TURNING_SPEEDS:
        clip = stride(character, speed, turn_rate)
        clips |= {f"left_{name}": clip, f"right_{name}": clip.mirrored()} if turn_rate else {name: clip}
    return clips


def _wandering(seed: int) -> tuple[Tensor, Tensor]:
    """Speeds and turn rates of all frames of the walks, each ``(WALKS, T)``."""
    generator = torch.Generator().manual_seed(seed)
    frames = round(DURATION * FPS) + 1
    noise = torch.randn(2, WALKS, frames + 2 * round(CHANGE * FPS), generator=generator, dtype=torch.float64)
    turns, speeds = (smoothed(process, FPS, CHANGE)[:, -frames:] for process in noise)
    turn_rates = smoothed(turns.sign() * _distributed(turns.abs(), TURN_RATE_QUANTILES), FPS, SMOOTHING)
    speeds = SPREAD * speeds / speeds.std() - SLOWING * turn_rates.abs()
    speeds = smoothed(_distributed(speeds, SPEED_QUANTILES), FPS, SMOOTHING)
    time = torch.arange(frames) / FPS
    for walk_index, moment in STOPS:
        away = ((time - moment).abs() - STOP / 2) / HALT
        going = minimum_jerk(away)
        speeds[walk_index] *= going
        turn_rates[walk_index] *= going
    return speeds, turn_rates


def _distributed(values: Tensor, quantiles: tuple[tuple[float, float], ...]) -> Tensor:
    """Replace values by the values of equal rank in a distribution."""
    ranks = values.flatten().argsort().argsort().view_as(values) / (values.numel() - 1)
    shares, values_there = np.array(quantiles).T
    return torch.from_numpy(np.interp(ranks.numpy(), shares, values_there))
