"""The shapes of walking: how a foot and the joints move over a stride, as keys for splines.

The phase of a stride is 0 when the heel strikes. A foot's own cycle is counted from the middle of its stance, where it
is flat on the ground, to the next: from 0.25 to 1.25. The keys follow published means of human walking near 1 m/s.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

MID_STANCE = 0.25
"""Phase at which one cycle of a foot ends and the next begins."""

TOE_OFF = 0.645
"""Phase at which a foot leaves the ground at 1 m/s."""

FOOT_PITCH = (
    (0.33, 0.0),
    (0.42, -2.5),
    (0.50, -9.0),
    (0.60, -34.0),
    (0.68, -69.0),
    (0.74, -61.5),
    (0.82, -35.0),
    (0.90, -6.0),
    (0.96, 16.0),
    (1.00, 21.0),
    (1.06, 9.0),
    (1.13, 0.0),
)
"""Degrees by which the toes point up; 0, flat on the ground, before and after."""

ADVANCE = ((0.57, 0.0), (0.70, 0.10), (0.80, 0.405), (0.90, 0.785), (0.96, 0.944), (1.0, 0.994), (1.03, 1.0))
"""Part of the way from one foothold to the next that the foot has gone."""

CLEARANCE = (
    (0.57, 0.0),
    (0.63, 0.028),
    (0.69, 0.080),
    (0.75, 0.091),
    (0.80, 0.070),
    (0.90, 0.0125),
    (0.95, 0.0105),
    (1.00, 0.0075),
    (1.04, 0.0),
)
"""Height of the foot's lowest point in metres. The heel arrives with a little speed, as heels do."""

ASIDE = ((0.57, 0.0), (0.80, 0.04), (1.03, 0.0))
"""Metres by which a foot swings outwards around the other leg in a curve, where that one points across its way."""

ROUNDING = ((0.80, 0.0), (0.90, 0.2), (1.02, 0.0))
"""Angle in radians within which the lowest point of a swinging foot passes smoothly from toe to heel."""


class Spline:
    r"""Cubic spline with continuous curvature and no slope at its ends, held beyond them.

    Between keys :math:`h` apart, at :math:`u \in [0, 1]`, it is the Hermite polynomial

    .. math:: (1 + 2u)(1 - u)^2 y_i + u (1 - u)^2 h m_i + u^2 (3 - 2u) y_{i+1} - u^2 (1 - u) h m_{i+1}

    whose slopes :math:`m` make the curvatures agree.

    Args:
        keys: Pairs of place and value, two or more, by increasing place.
    """

    def __init__(self, keys: Sequence[tuple[float, float]] | Tensor) -> None:
        self.places, self.values = torch.as_tensor(keys, dtype=torch.float64).T.contiguous()
        self.gaps = gaps = self.places.diff()
        rises = self.values.diff() / gaps
        diagonal = torch.ones_like(self.places)
        diagonal[1:-1] = 2 / gaps[:-1] + 2 / gaps[1:]
        off = 1 / gaps
        system = torch.diag(diagonal)
        system[1:-1, :-2] += torch.diag(off[:-1])
        system[1:-1, 2:] += torch.diag(off[1:])
        bends = torch.zeros_like(self.places)
        bends[1:-1] = 3 * (rises[:-1] / gaps[:-1] + rises[1:] / gaps[1:])
        self.slopes = torch.linalg.solve(system, bends)

    def __call__(self, place: Tensor) -> Tensor:
        """Value at any places, of the same shape."""
        place = place.clamp(self.places[0], self.places[-1])
        i = torch.searchsorted(self.places, place.contiguous(), right=True).clamp(1, len(self.gaps)) - 1
        h, u = self.gaps[i], (place - self.places[i]) / self.gaps[i]
        v = 1 - u
        before = (1 + 2 * u) * self.values[i] + u * h * self.slopes[i]
        after = (1 + 2 * v) * self.values[i + 1] - v * h * self.slopes[i + 1]
        return v * v * before + u * u * after


def wave(phase: Tensor, peak: float, harmonic: int = 1) -> Tensor:
    """Cosine of a stride's phase, or a harmonic of it, with a peak at phase ``peak``."""
    return torch.cos(2 * torch.pi * harmonic * (phase - peak))


def settled(amount: Tensor, scale: float) -> Tensor:
    """From 0 for nothing to 1 for much more than ``scale``, without slope at 0: 1 - exp(-(amount / scale)^2)."""
    return -torch.expm1(-((amount / scale) ** 2))
