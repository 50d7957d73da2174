"""Ranges of the quantities that a task draws for each episode, and mixtures of ranges."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from torchrl_mcp.values import Range, require


class Ranges:
    """Uniform distributions over named intervals, one number each per episode, with weighted alternatives.

    Args:
        ranges: Interval (lo, hi) by name.
        mixture: Alternatives. Each has intervals that replace those of ``ranges``, and a ``weight``, by default 1; its
            share of the sum of weights is its share of the episodes. Empty for ``ranges`` alone.

    Raises:
        ValueError: If an interval or a weight is invalid, or ``ranges`` lacks a name.

    Example:
        >>> near = {"weight": 3, "distances": (0.0, 1.0)}
        >>> ranges = Ranges({"distances": (1.0, 9.0)}, [near, {}])
        >>> distances = ranges.draw(1000, torch.Generator().manual_seed(0))["distances"]
        >>> 700 < (distances < 1).sum() < 800
        tensor(True)
    """

    def __init__(self, ranges: Mapping[str, Sequence[float]], mixture: Sequence[Mapping[str, Any]] = ()) -> None:
        alternatives = [dict(alternative) for alternative in mixture] or [{}]
        weights = [alternative.pop("weight", 1.0) for alternative in alternatives]
        if unknown := {name for alternative in alternatives for name in alternative} - set(ranges):
            raise ValueError(f"mixture names {sorted(unknown)}: pass weight and ranges of {list(ranges)}")
        if not all(0 < weight < float("inf") for weight in weights):
            raise ValueError(f"mixture has weights {weights}: pass finite numbers above 0")
        self._names = list(ranges)
        complete = [{**ranges, **alternative} for alternative in alternatives]
        for alternative in complete:
            for name, bounds in alternative.items():
                require(name, bounds, Range)
        pairs = [[(float(low), float(high)) for low, high in alternative.values()] for alternative in complete]
        self._bounds = torch.tensor(pairs, dtype=torch.float64)  # (alternatives, names, 2)
        self._weights = torch.tensor(weights, dtype=torch.float64)

    def draw(self, num: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw numbers for ``num`` episodes: by name, ``(num,)``, float64."""
        draws = max(num, 1)  # multinomial cannot draw an empty sample
        chosen = torch.multinomial(self._weights, draws, replacement=True, generator=generator)[:num]
        low, high = self._bounds[chosen].unbind(-1)
        shares = torch.rand(low.shape, dtype=torch.float64, device=low.device, generator=generator)
        drawn = low + (high - low) * shares
        return dict(zip(self._names, drawn.unbind(-1), strict=True))

    def to(self, device: torch.device) -> Self:
        """Move the ranges to the generator's device, and return them."""
        self._bounds = self._bounds.to(device)
        self._weights = self._weights.to(device)
        return self

    def require_distances(self, *names: str) -> None:
        """Check that ranges are distances.

        Raises:
            ValueError: If a range begins below 0.
        """
        for name in names:
            for low, high in self._of(name).tolist():
                if low < 0:
                    raise ValueError(f"{name}={(low, high)} begins below 0: pass two distances (lo, hi) in metres")

    def lowest(self, name: str) -> float:
        """Return the lowest number that may be drawn for a name, over all alternatives."""
        return float(self._of(name)[:, 0].min())

    def keep_clear(self, name: str, clearance: float) -> None:
        """Raise the lower bounds of distances to ``clearance`` metres, below which bodies would overlap.

        Raises:
            ValueError: If a range ends below ``clearance``.
        """
        bounds = self._of(name)
        for low, high in bounds.tolist():
            if high < clearance:
                raise ValueError(f"{name}={(low, high)} ends where bodies overlap: let it end beyond {clearance:.2f}")
        bounds[:, 0].clamp_(min=clearance)

    def _of(self, name: str) -> Tensor:
        """Bounds of a named range in all M alternatives, ``(M, 2)``, a live view."""
        return self._bounds[:, self._names.index(name)]
