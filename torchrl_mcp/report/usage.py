"""Usage of gates and options in evaluations: do the primitives share the work?"""

import math

from torchrl_mcp.evaluation.diagnostics import COLLAPSED
from torchrl_mcp.evaluation.statistics import shared_means
from torchrl_mcp.report.comparison import Cell
from torchrl_mcp.report.results import Run

WIDE_OPEN = 0.95
"""Mean weight from which the gates no longer choose: the composite is then the product of all primitives."""

RESTLESS = 0.9
"""Share of steps in which an option begins, from which options are no more than actions."""


def diagnostics(cell: Cell, group: str) -> dict[str, float]:
    """Means over seeds of the diagnostics of ``gates`` or ``options``, but for :func:`usage`; empty without any."""
    return shared_means([_diagnostics(run, group) for run in cell.complete], "usage_")


def usage(run: Run, group: str) -> list[float]:
    """How much each primitive is used: of ``gates`` the mean weight, of ``options`` the share of steps."""
    found = _diagnostics(run, group)
    return [found[f"usage_{index}"] for index in range(sum(name.startswith("usage_") for name in found))]


def verdict(run: Run, group: str) -> str | None:
    """What is wrong with the ``gates`` or ``options`` of a run, if anything is."""
    found = _diagnostics(run, group)
    if min(found.get("effective_primitives", math.inf), found.get("effective_options", math.inf)) < COLLAPSED:
        return "one does almost everything"
    if found.get("sum", 0.0) > WIDE_OPEN * len(usage(run, group)):
        return "all gates are open almost always"
    if found.get("begin_rate", 0.0) > RESTLESS:
        return "another begins at almost every step"
    return None


def _diagnostics(run: Run, group: str) -> dict[str, float]:
    found = run.evaluation["deterministic"].get("diagnostics", {})
    return {name.removeprefix(f"{group}/"): value for name, value in found.items() if name.startswith(f"{group}/")}
