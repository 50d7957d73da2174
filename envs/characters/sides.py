"""The two sides of a body, by the names of its parts."""

from collections.abc import Iterable

Sides = tuple[tuple[str, str], ...]
"""Pairs of beginnings or ends of names, for the right and the left side."""

SIDES: Sides = (("right_", "left_"),)

USUAL: Sides = (
    *SIDES,
    ("_right", "_left"),
    ("R_", "L_"),
    ("_R", "_L"),
    ("r_", "l_"),
    ("_r", "_l"),
    ("FR_", "FL_"),
    ("RR_", "RL_"),
    ("HR_", "HL_"),
    ("RF_", "LF_"),
    ("RH_", "LH_"),
    ("fr_", "fl_"),
    ("hr_", "hl_"),
    ("_fr", "_fl"),
    ("_hr", "_hl"),
    ("Right", "Left"),
    ("right", "left"),
)
"""Pairs that makers of robots use, the most distinct first."""


def twin(name: str, sides: Sides = SIDES) -> str:
    """Name of the same part on the other side of the body; a central part is its own twin.

    Args:
        name: Name of a body or a joint.
        sides: Beginnings or ends of names, right and left.

    Example:
        >>> twin("left_knee"), twin("FR_calf", (("FR_", "FL_"),)), twin("coxa_right", (("_right", "_left"),))
        ('right_knee', 'FL_calf', 'coxa_left')
    """
    for right, left in sides:
        for side, other in ((right, left), (left, right)):
            if name.startswith(side):
                return other + name.removeprefix(side)
            if name.endswith(side):
                return name.removesuffix(side) + other
    return name


def guessed_sides(names: Iterable[str]) -> Sides:
    """Return the usual pairs by which names come in twos, for :func:`twin`, without those that add none."""
    names = set(names)
    pairs: Sides = ()
    for pair in USUAL:
        paired = {name for name in names if twin(name, pairs) == name != twin(name, (pair,))}
        if paired and {twin(name, (pair,)) for name in paired} == paired:
            pairs += (pair,)
    return pairs
