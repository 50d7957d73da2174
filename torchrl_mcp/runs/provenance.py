"""Where a run comes from: command, code, choices and machine."""

import os
import platform
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig

from torchrl_mcp import __version__
from torchrl_mcp.training.precision import Precision

PACKAGE = Path(__file__).resolve().parents[1]


def origin(device: str, precision: Precision) -> dict[str, Any]:
    """Return what a run on ``device`` should remember of its beginning, JSON-compatible.

    Args:
        device: Where its networks are.
        precision: What they compute in.

    Returns:
        ``command`` as a list of words; ``commit`` of the library, with ``-dirty`` where files were changed since, or
        None where it is no checkout; its ``version``; ``choices``, the choice of each group of the configuration,
        where Hydra runs; ``precision`` of the networks and the reason for it; ``started``, an ISO time; and the
        ``machine``.
    """
    command, choices = list(sys.argv), {}
    if HydraConfig.initialized():
        hydra = HydraConfig.get()
        command = ["torchrl-mcp-train", *hydra.overrides.task]
        made = hydra.runtime.choices.items()
        choices = {group: choice for group, choice in made if choice and not group.startswith("hydra/")}
    return {
        "command": command,
        "commit": commit(PACKAGE),
        "version": __version__,
        "choices": choices,
        "precision": str(precision),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(device),
    }


def commit(folder: Path) -> str | None:
    """Return the abbreviated commit of the Git checkout that tracks ``folder``, or None."""
    if shutil.which("git") is None:
        return None
    # An installed package may lie in a checkout as well, which then says nothing of it.
    if not _git(folder, "ls-files", "."):
        return None
    return _git(folder, "describe", "--always", "--dirty", "--exclude=*")


def machine(device: str) -> dict[str, Any]:
    """Return processor, cores, device and the versions of all that makes numbers."""
    libraries = {name: version(name) for name in ("torch", "torchrl", "mujoco")}
    on_gpu = torch.device(device).type == "cuda"
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": torch.cuda.get_device_name(device) if on_gpu else device,
        "python": platform.python_version(),
        **libraries,
    }


def _processor() -> str:
    description = Path("/proc/cpuinfo")
    if description.exists():
        for line in description.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _git(folder: Path, *arguments: str) -> str | None:
    outcome = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
    return outcome.stdout.strip() or None if outcome.returncode == 0 else None
