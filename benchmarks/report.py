"""What benchmarks report: rows as text and as CSV, and what they were measured on.

The library is imported where it is needed, because benchmarks also run contenders in interpreters that lack it.
"""

import csv
import importlib.metadata
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any

PACKAGES = ("tensordict", "gymnasium", "numpy", "stable-baselines3")
"""Their versions are reported beside those of the machine's description."""


def about() -> dict[str, Any]:
    """Return commit, date, the description of the machine, and the versions of what is installed."""
    from torchrl_mcp.runs.machine import machine
    from torchrl_mcp.runs.provenance import commit

    versions = {}
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    here = Path(__file__).resolve().parent
    return {"commit": commit(here) or "", "date": date.today().isoformat(), **machine("cpu"), **versions}


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows of one set of keys as text, a line each."""
    from torchrl_mcp.runs.tables import text_table

    return text_table(rows)


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows of one set of keys as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
