"""Curves of a foot and the joints over a stride, as keys for splines.

The phase of a stride is 0 when the heel strikes. A foot's own cycle runs from one middle of its stance, where it is
flat on the ground, to the next: from 0.25 to 1.25. The keys follow published means of human walking near 1 m/s.
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
"""Pitch of the foot in degrees, toes up; 0 (flat on the ground) before the first key and after the last."""

ADVANCE = ((0.57, 0.0), (0.70, 0.10), (0.80, 0.405), (0.90, 0.785), (0.96, 0.944), (1.0, 0.994), (1.03, 1.0))
"""Share of the way from one foothold to the next that the foot has covered."""

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
"""Height of the foot's lowest point in metres. As in people, the heel lands with a small speed."""

ASIDE = ((0.57, 0.0), (0.80, 0.04), (1.03, 0.0))
"""Metres by which a foot swings outwards in a curve, around the other leg."""

ROUNDING = ((0.80, 0.0), (0.90, 0.2), (1.02, 0.0))
"""Pitch in radians over which the lowest point of a swinging foot moves smoothly from toe to heel."""


def spline(keys: Sequence[tuple[float, float]] | Tensor, place: Tensor) -> Tensor:
    """Evaluate a cubic spline with continuous curvature and zero slope at its ends, constant beyond them.

    Args:
        keys: Two or more pairs of place and value, by increasing place.
        place: Places to evaluate, of any shape, which the result shares.
    """
    from scipy.interpolate import CubicSpline  # slow to import, and only needed here

    places, values = torch.as_tensor(keys, dtype=torch.float64).T.numpy()
    curve = CubicSpline(places, values, bc_type="clamped")
    return torch.from_numpy(curve(place.clamp(places[0], places[-1]).numpy()))


def wave(phase: Tensor, peak: float, harmonic: int = 1) -> Tensor:
    """Cosine of a stride's phase, or a harmonic of it, with a peak at phase ``peak``."""
    return torch.cos(2 * torch.pi * harmonic * (phase - peak))


def settled(amount: Tensor, scale: float) -> Tensor:
    """Saturate from 0 to 1 over ``scale``, with zero slope at 0: 1 - exp(-(amount / scale)^2)."""
    return -torch.expm1(-((amount / scale) ** 2))
