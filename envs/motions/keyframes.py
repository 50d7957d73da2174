"""Splines through the keyframes of a cyclic motion."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

Keyframes = Sequence[tuple[float, float]]
"""Phases of a cycle in [0, 1), increasing, and values there."""


def smooth(keyframes: Keyframes, phase: Tensor) -> Tensor:
    """Pass through the keyframes with continuous acceleration: the periodic cubic spline.

    Args:
        keyframes: Three or more.
        phase: Any phases, shape ``(T,)``; whole numbers make no difference.
    """
    knots, values = np.array(keyframes).T
    curve = CubicSpline([*knots, knots[0] + 1], [*values, values[0]], bc_type="periodic")
    return torch.from_numpy(curve(phase.numpy()))


def halting(keyframes: Keyframes, phase: Tensor) -> Tensor:
    """Come to rest at every keyframe, without velocity or acceleration, and move by :func:`minimum_jerk` between them.

    Args:
        keyframes: One or more; equal values hold still.
        phase: As for :func:`smooth`.
    """
    values, index, u = _located(keyframes, phase)
    return torch.lerp(values[index], values.roll(-1)[index], minimum_jerk(u))


def minimum_jerk(u: Tensor) -> Tensor:
    """From rest at 0 to rest at 1 with the least mean square jerk, 10 u^3 - 15 u^4 + 6 u^5; held before and after."""
    u = u.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _located(keyframes: Keyframes, phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values at the knots, and each phase's interval between them and its place in it, 0 to 1."""
    knots, values = (torch.tensor(column, dtype=torch.float64) for column in zip(*keyframes, strict=True))
    width = torch.cat([knots, knots[:1] + 1]).diff()
    phase = knots[0] + (phase - knots[0]) % 1
    index = torch.searchsorted(knots, phase, right=True) - 1
    return values, index, (phase - knots[index]) / width[index]
