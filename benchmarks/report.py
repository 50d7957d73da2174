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

VECTOR_FLAGS = ("avx2", "fma", "avx512f", "avx512_bf16", "avx512_fp16", "avx_vnni", "amx")
"""Beginnings of the processor's flags that decide how fast a matrix product is."""


def about() -> dict[str, str | int]:
    """Return what the numbers were measured on, with what, and when."""
    cpu, flags = platform.processor(), []
    with suppress(OSError, KeyError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        described = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
        cpu = described["model name"]
        flags = [flag for flag in described["flags"].split() if flag.startswith(VECTOR_FLAGS)]
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
        "flags": " ".join(flags),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        **versions,
    }


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
