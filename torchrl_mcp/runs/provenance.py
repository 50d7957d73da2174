"""Where a run comes from: command, code, choices and machine."""

import os
import platform
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from torchrl_mcp import __version__

PACKAGE = Path(__file__).resolve().parents[1]


def provenance(device: str, command: Sequence[str], choices: Mapping[str, str]) -> dict[str, Any]:
    """Return where a run comes from, JSON-compatible.

    Args:
        device: Where its networks are.
        command: The words of the command that began it.
        choices: The choice of each group of its configuration.

    Returns:
        ``command``; ``commit`` of the library, with ``-dirty`` where files were changed since, or None where it is no
        checkout; its ``version``; ``choices``; ``started``, an ISO time; and the ``machine``.
    """
    return {
        "command": list(command),
        "commit": commit(PACKAGE),
        "version": __version__,
        "choices": dict(choices),
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
