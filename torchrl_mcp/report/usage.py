"""Judges the usage of gates and options in evaluations: whether the primitives share the work."""

import math

from torchrl_mcp.evaluation.diagnostics import COLLAPSED
from torchrl_mcp.report.cell import Cell
from torchrl_mcp.report.results import Run

WIDE_OPEN = 0.95
"""Above this mean weight the gates no longer select, because the composite is the product of all primitives."""

RESTLESS = 0.9
"""If an option begins in more than this share of steps, options last hardly longer than actions."""

PARTS = {"gates": "primitive", "options": "option"}
"""Names of the parts that share the work, by group of diagnostics."""


def diagnostics(cell: Cell, group: str) -> dict[str, float]:
    """Return the means over seeds of the diagnostics of ``gates`` or ``options``, except :func:`usage`."""
    return cell.over_seeds(lambda run: _diagnostics(run, group), "usage_")


def usage(run: Run, group: str) -> list[float]:
    """Return the usage of each primitive: its mean weight for ``gates``, its share of steps for ``options``."""
    values = _diagnostics(run, group)
    return [values[f"usage_{index}"] for index in range(sum(name.startswith("usage_") for name in values))]


def verdict(run: Run, group: str) -> str | None:
    """Return the description of a problem with the ``gates`` or ``options`` of a run, or None."""
    values = _diagnostics(run, group)
    parts = len(usage(run, group))
    effective = min(values.get("effective_primitives", math.inf), values.get("effective_options", math.inf))
    if parts > 1 and effective < COLLAPSED:
        return f"one {PARTS[group]} does almost all the work"
    if values.get("sum", 0.0) > WIDE_OPEN * parts:
        return "the gates are almost fully open, so they hardly select"
    if values.get("begin_rate", 0.0) > RESTLESS:
        return "a new option begins at almost every step"
    return None


def _diagnostics(run: Run, group: str) -> dict[str, float]:
    diagnostics = run.evaluation["deterministic"].get("diagnostics", {})
    return {
        name.removeprefix(f"{group}/"): value for name, value in diagnostics.items() if name.startswith(f"{group}/")
    }
