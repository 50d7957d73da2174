"""Smooth curves: splines through the keyframes of a cyclic motion, and averages over time."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

Keyframes = Sequence[tuple[float, float]]
"""Increasing phases of a cycle in [0, 1), with their values."""


def smooth(keyframes: Keyframes, phase: Tensor) -> Tensor:
    """Interpolate keyframes with continuous acceleration, by the periodic cubic spline.

    Args:
        keyframes: Three or more keyframes.
        phase: Any phases, shape ``(T,)``; only their fractional parts matter.
    """
    from scipy.interpolate import CubicSpline  # slow to import, and only needed here

    knots, values = np.array(keyframes).T
    curve = CubicSpline([*knots, knots[0] + 1], [*values, values[0]], bc_type="periodic")
    return torch.from_numpy(curve(phase.numpy()))


def halting(keyframes: Keyframes, phase: Tensor) -> Tensor:
    """Interpolate keyframes by :func:`minimum_jerk`, with zero velocity and acceleration at every keyframe.

    Args:
        keyframes: One or more keyframes.
        phase: Any phases, shape ``(T,)``; only their fractional parts matter.
    """
    values, index, u = _located(keyframes, phase)
    return torch.lerp(values[index], values.roll(-1)[index], minimum_jerk(u))


def minimum_jerk(u: Tensor) -> Tensor:
    """Move from rest at 0 to rest at 1 with the least mean square jerk, 10 u^3 - 15 u^4 + 6 u^5; constant outside."""
    u = u.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _located(keyframes: Keyframes, phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values at the knots, and the interval of each phase with the position in it, 0 to 1."""
    knots, values = (torch.tensor(column, dtype=torch.float64) for column in zip(*keyframes, strict=True))
    width = torch.cat([knots, knots[:1] + 1]).diff()
    phase = knots[0] + (phase - knots[0]) % 1
    index = torch.searchsorted(knots, phase, right=True) - 1
    return values, index, (phase - knots[index]) / width[index]


def smoothed(values: Tensor, fps: float, window: float) -> Tensor:
    """Average over time, the last dimension, with a Hann window of ``window`` seconds; the ends are held."""
    half = max(1, min(round(window * fps / 2), values.shape[-1] - 1))
    weights = torch.hann_window(2 * half + 1, periodic=False, dtype=values.dtype)
    padded = pad(values.reshape(-1, 1, values.shape[-1]), (half, half), mode="replicate")
    return conv1d(padded, (weights / weights.sum()).view(1, 1, -1)).view_as(values)
