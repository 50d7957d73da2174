"""Records the provenance of a run: command, code, choices and machine."""

import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig

from torchrl_mcp import __version__
from torchrl_mcp.training.precision import Precision

PACKAGE = Path(__file__).resolve().parents[1]
"""Folder of the library."""

CPUINFO = Path("/proc/cpuinfo")
"""Linux's description of the processors."""

INSTRUCTIONS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16")
"""Instruction sets on which torch's speed on a CPU depends; the last two concern bfloat16."""


def provenance(device: str, precision: Precision, inputs: Mapping[str, str]) -> dict[str, Any]:
    """Return the provenance of a run that begins, JSON-compatible.

    Args:
        device: Device of the networks.
        precision: Precision of the networks.
        inputs: Digests of the files outside the run folder, by the names of their settings.

    Returns:
        ``command``; ``commit`` of the library, with ``-dirty`` if files have changed since, or None without a checkout;
        ``version`` of the library; ``choices`` of config groups; ``precision`` with the reason for it; ``inputs``;
        ``started``, an ISO time; and ``machine``.
    """
    command, choices = launched()
    return {
        "command": command,
        "commit": commit(PACKAGE),
        "version": __version__,
        "choices": choices,
        "precision": str(precision),
        "inputs": dict(inputs),
        "started": _now(),
        "machine": machine(device),
    }


def continuation(origin: Mapping[str, Any], planned: int, total: int, frames: int) -> dict[str, Any]:
    """Return the provenance of a run whose length changes.

    Args:
        origin: The provenance so far.
        planned: Environment steps of the run as planned so far.
        total: Environment steps of the run as planned from now on.
        frames: Environment steps that the run has taken.

    Returns:
        ``origin`` with a further entry in ``extended``.
    """
    entry = {"command": launched()[0], "started": _now(), "planned": planned, "total_frames": total, "after": frames}
    return {**origin, "extended": [*origin.get("extended", []), entry]}


def launched() -> tuple[list[str], dict[str, str]]:
    """Return command line and choices of config groups, of the run that Hydra launched or else of this process."""
    if not HydraConfig.initialized():
        return list(sys.argv), {}
    hydra = HydraConfig.get()
    groups = hydra.runtime.choices.items()
    choices = {group: choice for group, choice in groups if choice and not group.startswith("hydra/")}
    return ["torchrl-mcp-train", *hydra.overrides.task], choices


def commit(folder: Path, *, results: Path | None = None) -> str | None:
    """Return the abbreviated commit of the Git checkout that tracks ``folder``, or None.

    Args:
        folder: A folder of the checkout.
        results: A folder of the checkout whose changes do not make the commit ``-dirty``.
    """
    if shutil.which("git") is None:
        return None
    # An installed package may lie inside the checkout of another project, which does not track the package.
    if not _git(folder, "ls-files", "."):
        return None
    head = _git(folder, "describe", "--always", "--abbrev=7", "--exclude=*")
    ignored = [f":(exclude){results}"] if results else []
    return f"{head}-dirty" if _git(folder, "diff", "--name-only", "HEAD", "--", ":/", *ignored) else head


def _git(folder: Path, *arguments: str) -> str | None:
    outcome = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
    return outcome.stdout.strip() or None if outcome.returncode == 0 else None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def machine(device: str) -> dict[str, Any]:
    """Return a description of this machine, JSON-compatible.

    Returns:
        ``processor``, its model; ``instructions``, the available ones of :data:`INSTRUCTIONS` separated by spaces, or
        an empty text if unknown; ``cores``, the number that this process may use; ``device``, the model of the GPU or
        else ``device`` itself; and the versions of ``python``, ``torch``, ``torchrl`` and ``mujoco``.
    """
    facts = processor_facts()
    flags = facts.get("flags", "").split()
    on_gpu = torch.device(device).type == "cuda"
    return {
        "processor": facts.get("model name") or platform.processor() or platform.machine(),
        "instructions": " ".join(name for name in INSTRUCTIONS if name in flags),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": torch.cuda.get_device_name(device) if on_gpu else device,
        "python": platform.python_version(),
        "torch": str(torch.__version__),  # includes the build, which the version of the package omits
        **{name: version(name) for name in ("torchrl", "mujoco")},
    }


def processor_facts() -> dict[str, str]:
    """Return Linux's facts about the first processor, by name; empty on other systems."""
    if not CPUINFO.exists():
        return {}
    first, _, _ = CPUINFO.read_text().partition("\n\n")
    pairs = (line.partition(":") for line in first.splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}
