"""Computes means over episodes and seeds, with bootstrap intervals by SciPy."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95
"""Level of all intervals."""

BATCH = 10_000_000
"""Number of values that are resampled at a time, which limits the memory."""


@dataclass(frozen=True)
class Estimate:
    """A number with its uncertainty.

    Attributes:
        value: The number.
        low: Lower end of the 95 % interval, NaN if a single value cannot be resampled.
        high: Upper end of the interval, likewise.
    """

    value: float
    low: float = math.nan
    high: float = math.nan


def mean(values: Sequence[float]) -> Estimate:
    """Return the mean with its percentile bootstrap interval.

    The interval of three values is their range, because one resample in 27 consists only of the smallest value.

    Raises:
        ValueError: If there is no value.
    """
    return _estimate([values], np.mean, len(values))


def difference(first: Sequence[float], second: Sequence[float]) -> Estimate:
    """Return the first mean minus the second, with the percentile bootstrap interval that resamples each sample.

    Raises:
        ValueError: If a sample has no value.
    """

    def minus(*samples: np.ndarray, axis: int) -> np.ndarray:
        return np.asarray(samples[0].mean(axis) - samples[1].mean(axis))

    return _estimate([first, second], minus, len(first) + len(second))


def deviation(values: Sequence[float]) -> float:
    """Return the standard deviation of a sample, with the divisor ``n - 1``; NaN for a single value."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def interquartile_mean(strata: Sequence[Sequence[float]]) -> Estimate:
    """Return the mean of the middle half of all values, with a bootstrap interval that resamples within each stratum.

    Strata have equal weights, even if their sizes differ.

    Args:
        strata: Values by task, one value per seed.

    Raises:
        ValueError: If a stratum has no value.

    Reference:
        Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", 2021,
        https://arxiv.org/abs/2108.13264
    """
    from scipy.stats import trim_mean  # slow to import

    def middle(*samples: np.ndarray, axis: int) -> np.ndarray:
        size = math.lcm(*(sample.shape[axis] for sample in samples))
        equal = [np.repeat(sample, size // sample.shape[axis], axis=axis) for sample in samples]
        return np.asarray(trim_mean(np.concatenate(equal, axis=axis), 0.25, axis=axis))

    return _estimate(strata, middle, len(strata) * math.lcm(*map(len, strata)))


def probability_of_improvement(pairs: Sequence[tuple[Sequence[float], Sequence[float]]]) -> Estimate:
    """Return the probability that a run of one method is better than a run of another, on average over tasks.

    Equal values count half. The bootstrap interval resamples within each task and method.

    Args:
        pairs: Values of the first and of the second method, one value per seed, for every task.

    Raises:
        ValueError: If there is no task, or a task has no value.

    Reference:
        Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", 2021,
        https://arxiv.org/abs/2108.13264
    """

    def ahead(*samples: np.ndarray, axis: int) -> np.ndarray:
        tasks = zip(samples[::2], samples[1::2], strict=True)
        signs = [np.sign(x[..., :, None] - y[..., None, :]).mean((-2, -1)) for x, y in tasks]
        return np.asarray(np.mean(signs, axis=0) / 2 + 0.5)

    return _estimate([values for pair in pairs for values in pair], ahead, sum(len(x) * len(y) for x, y in pairs))


def shared_means(numbers: Sequence[Mapping[str, float]], left_out: str | tuple[str, ...] = ()) -> dict[str, float]:
    """Return the means, by name, of the numbers that all runs have, except names that begin with ``left_out``."""
    shared = [name for name in (numbers[0] if numbers else {}) if all(name in run for run in numbers)]
    names = [name for name in shared if not name.startswith(left_out)]
    return {name: sum(run[name] for run in numbers) / len(numbers) for name in names}


def _estimate(strata: Sequence[Sequence[float]], statistic: Callable[..., np.ndarray], size: int) -> Estimate:
    """Return a statistic with its interval; ``size`` is the number of values that it computes per resample."""
    from scipy.stats import bootstrap  # slow to import

    if not strata or not all(len(values) for values in strata):
        raise ValueError(f"values={list(map(list, strata))} must have no empty list: omit what was not evaluated")
    value = float(statistic(*map(np.asarray, strata), axis=-1))
    if any(len(values) < 2 for values in strata):
        return Estimate(value)
    interval = bootstrap(
        strata,
        statistic,
        vectorized=True,
        method="percentile",
        confidence_level=CONFIDENCE,
        batch=max(1, BATCH // size),
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))
