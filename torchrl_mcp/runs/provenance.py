"""The provenance of a run: command, code, choices and machine."""

import shutil
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from torchrl_mcp import __version__
from torchrl_mcp.runs.machine import machine
from torchrl_mcp.training.precision import Precision

PACKAGE = Path(__file__).resolve().parents[1]


def provenance(device: str, command: Sequence[str], choices: Mapping[str, str], precision: Precision) -> dict[str, Any]:
    """Return the provenance of a run, JSON-compatible.

    Args:
        device: Device of the networks.
        command: Words of the command that started the run.
        choices: Choice of each group of the configuration.
        precision: Precision of the networks.

    Returns:
        ``command``; ``commit`` of the library, with ``-dirty`` if files were changed since, or None without a
        checkout; its ``version``; ``choices``; ``precision`` and the reason for it; ``started``, an ISO time; and the
        ``machine``.
    """
    return {
        "command": list(command),
        "commit": commit(PACKAGE),
        "version": __version__,
        "choices": dict(choices),
        "precision": str(precision),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(device),
    }


def commit(folder: Path) -> str | None:
    """Return the abbreviated commit of the Git checkout that tracks ``folder``, or None."""
    if shutil.which("git") is None:
        return None
    # An installed package may lie inside an unrelated checkout, which does not track it.
    if not _git(folder, "ls-files", "."):
        return None
    return _git(folder, "describe", "--always", "--dirty", "--exclude=*")


def _git(folder: Path, *arguments: str) -> str | None:
    outcome = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
    return outcome.stdout.strip() or None if outcome.returncode == 0 else None
