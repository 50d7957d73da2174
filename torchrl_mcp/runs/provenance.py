"""The provenance of a run: command, code, choices and machine."""

import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from torchrl_mcp import __version__
from torchrl_mcp.runs.machine import machine

PACKAGE = Path(__file__).resolve().parents[1]


def origin(device: str) -> dict[str, Any]:
    """Return what a run on ``device`` should remember of its beginning, JSON-compatible.

    Returns:
        ``command`` as a list of words; ``commit`` of the library, with ``-dirty`` where files were changed since, or
        None where it is no checkout; its ``version``; ``choices``, the choice of each group of the configuration,
        where Hydra runs; ``started``, an ISO time; and the ``machine``.
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


def _git(folder: Path, *arguments: str) -> str | None:
    outcome = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
    return outcome.stdout.strip() or None if outcome.returncode == 0 else None
