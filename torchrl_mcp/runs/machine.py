"""Description of the machine of a measurement."""

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

CPUINFO = Path("/proc/cpuinfo")

INSTRUCTIONS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16")
"""Instruction sets on which torch's speed on a CPU depends; the last two are for bfloat16."""


def machine(device: str) -> dict[str, Any]:
    """Describe this machine, JSON-compatible.

    Returns:
        ``processor``, the model; ``instructions``, the available ones of :data:`INSTRUCTIONS`, separated by spaces
        (empty if unknown); ``cores``, the number that this process may use; ``device``, the model of a GPU or
        ``device`` itself; and the versions of ``python``, ``torch``, ``torchrl`` and ``mujoco``.
    """
    facts = _cpuinfo()
    flags = facts.get("flags", "").split()
    on_gpu = torch.device(device).type == "cuda"
    return {
        "processor": facts.get("model name") or platform.processor() or platform.machine(),
        "instructions": " ".join(name for name in INSTRUCTIONS if name in flags),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": torch.cuda.get_device_name(device) if on_gpu else device,
        "python": platform.python_version(),
        "torch": str(torch.__version__),  # with the build, which the version of the package leaves out
        **{name: version(name) for name in ("torchrl", "mujoco")},
    }


def _cpuinfo() -> dict[str, str]:
    """Return Linux's facts about the first processor, by name; empty on other systems."""
    if not CPUINFO.exists():
        return {}
    first, _, _ = CPUINFO.read_text().partition("\n\n")
    pairs = (line.partition(":") for line in first.splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}
