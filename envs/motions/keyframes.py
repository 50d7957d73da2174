"""Splines through the keyframes of a cyclic motion."""

from collections.abc import Sequence

import torch
from torch import Tensor

Keyframes = Sequence[tuple[float, float]]
"""Phases of a cycle in [0, 1), increasing, and values there."""


def smooth(keyframes: Keyframes, phase: Tensor) -> Tensor:
    r"""Pass through the keyframes with continuous acceleration: the periodic cubic spline.

    Between two knots at distance :math:`h`, at the fraction :math:`u` of the way,

    .. math:: y = (1 - u) y_i + u y_{i+1} + \tfrac{h^2}{6} \left( ((1 - u)^3 - (1 - u)) m_i + (u^3 - u) m_{i+1} \right)

    with second derivatives :math:`m_i` that make the first derivatives meet at every knot.

    Args:
        keyframes: Three or more.
        phase: Any phases, shape ``(T,)``; whole numbers make no difference.
    """
    values, width, index, u = _located(keyframes, phase)
    slope, previous = (values.roll(-1) - values) / width, width.roll(1)
    rows, system = torch.arange(len(values)), torch.zeros(len(values), len(values), dtype=torch.float64)
    system[rows, rows] = 2 * (previous + width)
    system[rows, rows - 1] = previous
    system[rows, (rows + 1) % len(values)] = width
    curvature = torch.linalg.solve(system, 6 * (slope - slope.roll(1)))
    v = 1 - u
    bend = (v**3 - v) * curvature[index] + (u**3 - u) * curvature.roll(-1)[index]
    return v * values[index] + u * values.roll(-1)[index] + bend * width[index] ** 2 / 6


def halting(keyframes: Keyframes, phase: Tensor) -> Tensor:
    """Come to rest at every keyframe, without velocity or acceleration, and move by :func:`minimum_jerk` between them.

    Args:
        keyframes: One or more; equal values hold still.
        phase: As for :func:`smooth`.
    """
    values, _, index, u = _located(keyframes, phase)
    return torch.lerp(values[index], values.roll(-1)[index], minimum_jerk(u))


def minimum_jerk(u: Tensor) -> Tensor:
    """From rest at 0 to rest at 1 with the least mean square jerk, 10 u^3 - 15 u^4 + 6 u^5; held before and after."""
    u = u.clamp(0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def _located(keyframes: Keyframes, phase: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Values at the knots, widths of the intervals after them, each phase's interval and its place in it, 0 to 1."""
    knots, values = (torch.tensor(column, dtype=torch.float64) for column in zip(*keyframes, strict=True))
    width = torch.cat([knots, knots[:1] + 1]).diff()
    phase = knots[0] + (phase - knots[0]) % 1
    index = torch.searchsorted(knots, phase, right=True) - 1
    return values, width, index, (phase - knots[index]) / width[index]
