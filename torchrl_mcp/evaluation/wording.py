"""Numbers in words, for messages and pages."""

from collections.abc import Mapping


def duration(seconds: float) -> str:
    """Return a duration in words.

    >>> duration(20), duration(90), duration(9000)
    ('20 s', '2 min', '2.5 h')
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def skill_text(reach: Mapping[str, float]) -> str:
    """Return one line about the ``reach`` of :func:`~torchrl_mcp.evaluation.rollout.episode_statistics`.

    >>> skill_text({"skill": 0.5, "standing": 0.2, "ideal": 0.8})
    '50% of the way from standing still (0.200) to an ideal player (0.800)'
    """
    standing = f"standing still ({reach['standing']:.3f})"
    ideal = f"an ideal player ({reach['ideal']:.3f})"
    return f"{reach['skill']:.0%} of the way from {standing} to {ideal}"
