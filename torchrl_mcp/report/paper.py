"""Contains the paper's results, with which reports compare.

Reference:
    Peng et al., "MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies", NeurIPS
    2019, https://arxiv.org/abs/1905.09808
"""

from typing import NamedTuple


class Reported(NamedTuple):
    """Mean and standard deviation of a normalised return over the paper's three seeds."""

    mean: float
    std: float


TITLES = {
    "scratch": "Scratch",
    "finetune": "Finetune",
    "hierarchical": "Hierarchical",
    "option_critic": "Option critic",
    "moe": "MOE",
    "latent_space": "Latent space",
    "mcp": "MCP",
}
"""Titles of the columns of Table 2, by the name of the method."""

METHODS = tuple(TITLES)
"""Names of the methods in Table 2."""

CHARACTERS = {"biped": "Biped", "humanoid": "Humanoid", "trex": "T-Rex", "ant": "Ant"}
"""Titles of the paper's characters."""

# Table 2: means and standard deviations, one column per method; None stands for a dash.
_ROWS: dict[tuple[str, str], tuple[list[float | None], list[float | None]]] = {
    ("heading", "biped"): (
        [0.927, 0.970, 0.834, 0.952, 0.918, 0.970, 0.976],
        [0.032, 0.002, 0.001, 0.012, 0.002, 0.001, 0.002],
    ),
    ("heading", "humanoid"): (
        [0.965, 0.975, 0.681, 0.958, 0.857, 0.969, 0.970],
        [0.010, 0.008, 0.006, 0.001, 0.018, 0.002, 0.003],
    ),
    ("heading", "trex"): (
        [0.840, 0.953, None, 0.830, 0.672, 0.686, 0.932],
        [0.003, 0.004, None, 0.004, 0.011, 0.003, 0.007],
    ),
    ("carry", "biped"): (
        [0.027, 0.324, 0.001, 0.346, 0.013, 0.456, 0.575],
        [0.035, 0.014, 0.002, 0.011, 0.013, 0.031, 0.032],
    ),
    ("dribble", "biped"): (
        [0.072, 0.651, 0.546, 0.046, 0.073, 0.768, 0.782],
        [0.012, 0.025, 0.024, 0.008, 0.021, 0.012, 0.008],
    ),
    ("dribble", "humanoid"): (
        [0.076, 0.598, 0.198, 0.058, 0.043, 0.751, 0.805],
        [0.024, 0.030, 0.002, 0.007, 0.021, 0.006, 0.006],
    ),
    ("dribble", "trex"): (
        [0.065, 0.074, None, 0.098, 0.070, 0.115, 0.781],
        [0.032, 0.011, None, 0.013, 0.017, 0.013, 0.021],
    ),
    ("holdout", "ant"): (
        [0.951, 0.885, None, None, None, 0.745, 0.812],
        [0.093, 0.062, None, None, None, 0.060, 0.030],
    ),
}

TABLE_2 = {
    (*place, method): Reported(mean, std)
    for place, row in _ROWS.items()
    for method, mean, std in zip(METHODS, *row, strict=True)
    if mean is not None and std is not None
}
"""Normalised return of final policies by ``(task, character, method)``."""

PLACES = list(_ROWS)
"""Pairs of task and character, in the order of Table 2."""
