"""Checks of arguments."""

import math
from collections.abc import Sequence
from numbers import Real


def interval(name: str, value: Sequence[float]) -> tuple[float, float]:
    """Check that ``value`` is a pair of finite numbers in order, and return it.

    Raises:
        ValueError: If it is not.
    """
    try:
        low, high = map(float, value)
    except (TypeError, ValueError):
        low, high = math.nan, math.nan
    if not -math.inf < low <= high < math.inf:
        raise ValueError(f"{name}={value!r} must be an interval: pass two finite numbers (lo, hi), lo <= hi")
    return low, high


def not_negative(**values: float) -> None:
    """Check that values are finite and at least 0.

    Raises:
        ValueError: If one is not, with its name.
    """
    for name, value in values.items():
        if not (isinstance(value, Real) and 0.0 <= value < math.inf):
            raise ValueError(f"{name}={value} is out of range: pass a finite number of at least 0")


def positive(**values: float) -> None:
    """Check that values are finite and above 0.

    Raises:
        ValueError: If one is not, with its name.
    """
    for name, value in values.items():
        if not (isinstance(value, Real) and 0.0 < value < math.inf):
            raise ValueError(f"{name}={value} is out of range: pass a finite number above 0")
