"""Strides found in a walk by the movement of the feet relative to the root."""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

from torch import Tensor

from torchrl_mcp.envs.motions.inspection.signals import LegSignals

STRIKE_DELAY = 0.019
"""Delay in seconds of a heel strike after the ankle is furthest ahead of the root, from other measurements."""

SWING = 0.03
"""Distance in metres by which an ankle passes the root in a step; smaller movements are no steps."""

LONGEST = 1.8
"""Longest stride in seconds; longer ones include a stop."""


class Stride(NamedTuple):
    """From a heel strike to the next of the same foot, in frames.

    Args:
        side: ``"right"`` or ``"left"``.
        start: Frame of the heel strike.
        end: Frame of the next heel strike.
        toe_off: Frame in which the foot leaves the ground.
        other_start: Frame of the other foot's heel strike.
        other_toe_off: Frame in which the other foot leaves the ground.
    """

    side: str
    start: int
    end: int
    toe_off: int
    other_start: int
    other_toe_off: int

    @property
    def other(self) -> str:
        """The other side."""
        return "left" if self.side == "right" else "right"

    def part(self, start: float, end: float) -> slice:
        """Frames from one fraction of the stride to another."""
        frames = self.end - self.start
        return slice(self.start + int(start * frames), self.start + int(end * frames))


def find_strides(legs: Mapping[str, LegSignals], fps: float) -> list[Stride]:
    """Find all complete strides.

    A heel strikes 19 ms after its ankle is furthest ahead of the root; a foot leaves the ground when its toes are
    furthest behind.

    Args:
        legs: Signals of both legs.
        fps: Frames per second.
    """
    delay = round(STRIKE_DELAY * fps)
    strikes, toe_offs = {}, {}
    for side, leg in legs.items():
        ahead, behind = _excursions(leg.ahead)
        strikes[side] = [start + int(leg.ahead[start:end].argmax()) + delay for start, end in ahead]
        toe_offs[side] = [start + int(leg.toe_ahead[start:end].argmin()) for start, end in behind]
    strides = []
    for side, other in (("right", "left"), ("left", "right")):
        for start, end in pairwise(strikes[side]):
            events = (toe_offs[side], strikes[other], toe_offs[other])
            inside = [[frame for frame in frames if start < frame < end] for frames in events]
            if end - start <= LONGEST * fps and end < len(legs[side].ahead) and all(len(one) == 1 for one in inside):
                strides.append(Stride(side, start, end, *(frame for (frame,) in inside)))
    return strides


def _excursions(signal: Tensor) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Complete intervals of frames with a signal above ``SWING``, and with a signal below ``-SWING``."""
    away = (signal.abs() > SWING).nonzero().squeeze(-1)
    signs = signal[away].sign()
    turns = (signs.diff() != 0).nonzero().squeeze(-1) + 1
    crossings = [(int(signs[first]), (int(away[first]), int(away[last - 1]) + 1)) for first, last in pairwise(turns)]
    return [interval for sign, interval in crossings if sign > 0], [
        interval for sign, interval in crossings if sign < 0
    ]
