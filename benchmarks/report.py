"""What benchmarks report: rows as text and as CSV, and what they were measured on."""

import csv
import importlib.metadata
import os
import platform
import subprocess
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any


def about() -> dict[str, str | int]:
    """Return what the numbers were measured on, with what, and when."""
    cpu = platform.processor()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    commit = ""
    with suppress(OSError):
        command = ["git", "rev-parse", "--short", "HEAD"]
        folder = Path(__file__).resolve().parent
        commit = subprocess.run(command, capture_output=True, text=True, cwd=folder).stdout.strip()
    packages = ["torch", "torchrl", "tensordict", "mujoco", "gymnasium", "numpy", "stable-baselines3"]
    versions = {}
    for package in packages:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return {
        "commit": commit,
        "date": date.today().isoformat(),
        "cpu": cpu,
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        **versions,
    }


def instructions() -> str:
    """Return the sets of instructions of this processor that matter to tensors, as Linux names them."""
    wide = ("avx2", "fma", "avx512f", "avx512_bf16", "amx_bf16")
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        flags = next(line.split(":")[1].split() for line in lines if line.startswith("flags"))
        return " ".join(flag for flag in wide if flag in flags)
    return ""


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows of one set of keys as text, a line each."""
    lines = [list(rows[0]), *([str(value) if value != "" else "-" for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows of one set of keys as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
