"""Writes the rows of benchmarks as text and as CSV, with a description of the machine.

The library is imported inside functions, because benchmarks also run contenders in interpreters without the library.
"""

import csv
import importlib.metadata
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any

PACKAGES = ("tensordict", "gymnasium", "numpy", "stable-baselines3")
"""Packages whose versions are reported in addition to the machine's description."""


def about() -> dict[str, Any]:
    """Return commit, date, description of the machine, and versions of installed packages."""
    from torchrl_mcp.runs.provenance import commit, machine

    versions = {}
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    folder = Path(__file__).resolve().parent
    code = commit(folder, results=folder / "results")  # without the tables, which benchmarks write row by row
    return {"commit": code or "", "date": date.today().isoformat(), **machine("cpu"), **versions}


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows with the same keys as a text table."""
    from torchrl_mcp.runs.tables import text_table

    return text_table(rows)


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows with the same keys as CSV."""
    from torchrl_mcp.runs.tables import write_csv

    write_csv(rows, path)


def append(path: Path, row: dict[str, Any]) -> None:
    """Append a row to a CSV file, to which other processes may append too.

    The columns are those of the file; an entry that the row lacks is empty.
    """
    import fcntl  # only here, because Windows does not have it

    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", newline="") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        columns = next(csv.reader(file), None)
        writer = csv.DictWriter(file, columns or list(row), restval="", extrasaction="ignore")
        if columns is None:
            writer.writeheader()
        writer.writerow(row)


def peak_memory(pid: int) -> float:
    """Return the peak resident memory of a process and its descendants in MiB, on Linux.

    Pages that several processes share count for each of them.
    """
    total = 0.0
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM"):
                total = int(line.split()[1]) / 1024
        for task in Path(f"/proc/{pid}/task").iterdir():
            total += sum(peak_memory(int(child)) for child in (task / "children").read_text().split())
    return total
