r"""Measures specialisation for Figure 7: how weights depend on the walk cycle, and how far actions are separated.

Samples are rows. ``M`` is the number of samples, ``K`` of primitives, and ``A`` the size of an action.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PHASE_BINS = 20
"""Number of bins of a stride."""


def bin_means(values: Array, phases: Array, num_bins: int = PHASE_BINS) -> Array:
    """Return the mean in each of ``num_bins`` equal bins of the phase, ``(num_bins, K)``; NaN in empty bins.

    Args:
        values: Values, shape ``(M, K)``.
        phases: Phases in [0, 1), shape ``(M,)``.
        num_bins: Number of bins.
    """
    bins = (phases * num_bins).astype(int)
    counts = np.bincount(bins, minlength=num_bins)[:, None]
    sums = np.stack([np.bincount(bins, column, minlength=num_bins) for column in values.T], -1)
    return np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)


def explained_by_phase(values: Array, phases: Array, num_bins: int = PHASE_BINS) -> tuple[Array, float]:
    r"""Return the share of variance that the phase explains, whatever the form of the dependence.

    .. math:: \eta^2_k = \frac{\mathrm{Var}\left[\mathrm{E}[w_k | \phi]\right]}{\mathrm{Var}[w_k]}

    Args:
        values: Weights w, shape ``(M, K)``.
        phases: Phases in [0, 1), shape ``(M,)``.
        num_bins: Number of bins; the mean is taken as constant within a bin.

    Returns:
        The share of each column, ``(K,)``, which is 0 for constant columns, and the share of all columns together.
    """
    deviation = values - values.mean(0)
    predicted = bin_means(deviation, phases, num_bins)[(phases * num_bins).astype(int)]
    explained = np.square(predicted).sum(0)
    total = np.square(deviation).sum(0)
    return _ratio(explained, total), float(_ratio(explained.sum(), total.sum()))


def circular_correlation(values: Array, phases: Array) -> Array:
    r"""Return the squared correlation of each column with a wave of one period per stride, ``(K,)``.

    .. math:: R^2 = 1 - \min_{a, b, c} \frac{\sum (w - a - b \cos 2 \pi \phi - c \sin 2 \pi \phi)^2}
        {\sum (w - \bar w)^2}

    Args:
        values: Weights w, shape ``(M, K)``.
        phases: Phases in [0, 1), shape ``(M,)``.

    Reference:
        Mardia, Linear-circular correlation coefficients and rhythmometry, 1976, https://doi.org/10.1093/biomet/63.2.403
    """
    angle = 2 * np.pi * phases
    waves = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], -1)
    fitted = waves @ np.linalg.lstsq(waves, values, rcond=None)[0]
    return _ratio(np.square(fitted - values.mean(0)).sum(0), np.square(values - values.mean(0)).sum(0))


def stance_correlation(values: Array, standing: NDArray[np.bool_]) -> Array:
    """Return the correlation of each column with left minus right foot on the ground, ``(K,)``.

    The correlation is 1 for a weight that is high when only the left foot stands and low when only the right foot
    stands, and -1 for the opposite.

    Args:
        values: Weights, shape ``(M, K)``.
        standing: Whether the right and the left foot stand, shape ``(M, 2)``.
    """
    side = standing[:, 1].astype(float) - standing[:, 0]
    side = side - side.mean()
    values = values - values.mean(0)
    norms = np.sqrt(np.square(side).sum() * np.square(values).sum(0))
    return _ratio(side @ values, norms)


def principal_components(actions: Array, num: int = 2) -> tuple[Array, Array]:
    """Return the principal components of actions, ``(M, num)``, and their shares of the variance, ``(num,)``.

    Components beyond the number of actions are 0.

    Args:
        actions: Actions, shape ``(M, A)``.
        num: Number of components.
    """
    centred = actions - actions.mean(0)
    _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
    scores = centred @ directions[:num].T
    shares = _ratio(np.square(sizes[:num]), np.square(sizes).sum())
    missing = num - len(shares)
    return np.pad(scores, ((0, 0), (0, missing))), np.pad(shares, (0, missing))


def between_primitives(actions: Array) -> float:
    """Return the share of the variance of actions that lies between the means of the primitives.

    Args:
        actions: Mean action of every primitive in the same states, shape ``(M, K, A)``.
    """
    deviation = actions - actions.mean((0, 1))
    return float(_ratio(np.square(deviation.mean(0)).sum() * len(actions), np.square(deviation).sum()))


def silhouettes(actions: Array) -> Array:
    r"""Return the mean silhouette of each primitive's actions, ``(K,)``.

    .. math:: s = \frac{b - a}{\max(a, b)}

    with a the mean distance of an action from the other actions of its primitive, and b its mean distance from the
    actions of the nearest other primitive. The silhouette is 1 for well separated actions, 0 on the border, and
    negative among the actions of another primitive. A single primitive has 0.

    Args:
        actions: Mean action of every primitive in the same states, shape ``(M, K, A)``, M at least 2.

    Reference:
        Rousseeuw, Silhouettes, 1987, https://doi.org/10.1016/0377-0427(87)90125-7
    """
    num_states, num_primitives, _ = actions.shape
    if num_primitives == 1:
        return np.zeros(1)
    points = actions.swapaxes(0, 1).reshape(num_states * num_primitives, -1)
    squares = np.square(points).sum(-1)
    distances = np.sqrt((squares[:, None] + squares - 2 * points @ points.T).clip(min=0.0))
    np.fill_diagonal(distances, 0.0)
    sums = distances.reshape(num_primitives, num_states, num_primitives, num_states).sum(-1)
    indices = np.arange(num_primitives)
    within = sums[indices, :, indices] / (num_states - 1)
    sums[indices, :, indices] = np.inf
    nearest = sums.min(-1) / num_states
    return _ratio(nearest - within, np.maximum(within, nearest)).mean(-1)


def _ratio(numerator: Array, denominator: Array) -> Array:
    """Return quotients, which are 0 where the denominator is 0."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0)
