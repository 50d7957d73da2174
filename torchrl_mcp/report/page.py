"""Writes the results of many runs next to the paper's results, as a web page and as Markdown."""

import math
from collections.abc import Sequence
from datetime import datetime
from itertools import count
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from torchrl_mcp import __version__
from torchrl_mcp.evaluation.wording import duration
from torchrl_mcp.report.cell import Cell
from torchrl_mcp.report.comparison import cells, methods
from torchrl_mcp.report.paper import TABLE_2
from torchrl_mcp.report.results import STATES, Damaged, Run
from torchrl_mcp.report.sections import (
    PAGE_COLOURS,
    Row,
    Section,
    ablation_chapters,
    diagnostic_tables,
    method_colours,
    place_title,
    row,
    task_sections,
)
from torchrl_mcp.report.svg import inline_svg
from torchrl_mcp.report.table_2 import describe, draw_table_2, over_rows
from torchrl_mcp.training import precision
from torchrl_mcp.training.run_folder import MODES

PAGES = ("report.html", "report.md")
"""Names of the templates and of the files of a report."""

HARDWARE = ("processor", "cores", "device")
LIBRARIES = ("python", "torch", "torchrl", "mujoco")
"""Parts of a machine's description in a run's provenance."""


def report(runs: Sequence[Run], damaged: Sequence[Damaged], *, moment: datetime) -> dict[str, str]:
    """Return the report by file name, ``report.html`` and ``report.md``.

    Args:
        runs: Runs in any state.
        damaged: Folders that cannot be read.
        moment: Time at which the folders were read.
    """
    environment = Environment(
        loader=PackageLoader("torchrl_mcp.report"),
        autoescape=lambda name: str(name).endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FILTERS
    context = _context(runs, damaged) | {"moment": f"{moment:%Y-%m-%d %H:%M %Z}", "version": __version__}
    return {name: environment.get_template(name).render(context) for name in PAGES}


def _context(runs: Sequence[Run], damaged: Sequence[Damaged]) -> dict[str, Any]:
    """Return the variables of the templates."""
    groups = cells(runs)
    stages = {stage: [cell for cell in groups if cell.stage == stage] for stage in ("transfer", "pretrain")}
    names = (f"plot-{number}" for number in count(1))
    machines = list(dict.fromkeys(map(_machine, runs)))
    shared, aggregate = over_rows(groups)
    palette = method_colours(groups)
    context = {
        "runs": [run for cell in groups for run in cell.runs],
        "states": states(runs, damaged),
        "damaged": [*damaged, *(Damaged(run.path, run.fault) for run in runs if run.fault)],
        "overview": _overview([row(cell) for cell in stages["transfer"] if cell.is_standard]),
        "picture": _picture(groups),
        "has_reported": any(cell.reported for cell in groups),
        "titles": methods(groups),
        "shared": shared,
        "aggregate": aggregate if min(len(shared), len(aggregate)) > 1 else {},
        "transfer": task_sections(stages["transfer"], names, palette),
        "ablations": ablation_chapters(groups, names),
        "diagnostics": diagnostic_tables(groups),
        "pretraining": task_sections(stages["pretrain"], names, palette),
        "machines": machines,
    }
    return context | {
        "modes": MODES,
        "table_2": TABLE_2,
        "isfinite": math.isfinite,
        "machine_number": lambda run: machines.index(_machine(run)) + 1,
    }


def states(runs: Sequence[Run], damaged: Sequence[Damaged]) -> dict[str, int]:
    """Return the number of runs by state."""
    states = [run.state for run in runs] + ["damaged"] * len(damaged)
    return {state: states.count(state) for state in STATES}


def _picture(groups: Sequence[Cell]) -> dict[str, Any]:
    """Return Table 2 as bars, with a width in ``rem`` that fits its text; empty if no row has been run."""
    if not (figure := draw_table_2(groups)):
        return {}
    svg = inline_svg(figure, "table-2", describe(groups), PAGE_COLOURS)
    return {"svg": svg, "width": round(6.4 * figure.get_figwidth())}


def _overview(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the columns and rows of Table 2: the methods, and a section per task and character."""
    places = dict.fromkeys(r.cell.place for r in rows)
    sections = {place: Section(place_title(place), [r for r in rows if r.cell.place == place]) for place in places}
    return {"methods": methods(r.cell for r in rows), "sections": sections}


def _machine(run: Run) -> str:
    """Return the machine, the precision of the networks and the libraries of a run in one line."""
    machine = run.provenance.get("machine") or {}
    parts = (
        f"{machine[name]} cores" if name == "cores" else f"{machine[name]}" for name in HARDWARE if name in machine
    )
    autocast = run.settings.get("autocast")
    networks = [f"networks in {precision.name(autocast)}"] if isinstance(autocast, bool) else []
    versions = (f"{name} {machine[name]}" for name in LIBRARIES if name in machine)
    return ", ".join([*parts, *networks, *versions]) or "unknown"


FILTERS = {
    "figure": "{:.3f}".format,
    "percent": "{:.0%}".format,
    "signed": lambda value: f"{value:+.3f}".replace("-", "−"),
    "steps": "{:,}".format,
    "duration": duration,
    "capital": lambda text: text[:1].upper() + text[1:],
    "words": lambda name: name.replace("_", " ").capitalize(),
    "place": place_title,
    "cell": lambda text: str(text).replace("|", r"\|").replace("\n", " "),
}
"""Filters of the templates. ``cell`` escapes text for Markdown's tables."""
