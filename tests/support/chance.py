"""Bounds from distributions: which outcomes of many episodes would be no accident on any processor."""

from scipy.stats import binom

ACCIDENT = 1e-6
"""Probability with which a test may fail although the share of successes is as measured."""


def require_share(outcomes, share):
    """Require that as many episodes succeed as a share of all of them lets expect.

    Args:
        outcomes: Whether each episode succeeded, ``(N,)``, bool. Episodes are independent.
        share: The share of successes, as measured over at least 500 episodes, less a few hundredths.
    """
    least = int(binom.ppf(ACCIDENT, len(outcomes), share))
    successes = int(outcomes.sum())
    assert successes >= least, f"{successes} of {len(outcomes)} episodes succeeded; {least} are expected at the least"
