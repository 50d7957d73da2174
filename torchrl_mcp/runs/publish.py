"""Writes and reads published checkpoints, which contain only the policy and are as small as the built-in networks.

A gate that was trained over built-in primitives is published without the primitives. The file lists the fingerprints of
these *shared* parts, which are loaded from the built-in networks when the file is restored.
"""

import copy
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.transfer import fingerprint


def publish(
    parts: nn.ModuleDict, config: Mapping[str, Any], path: Path, *, shared: Mapping[str, str] | None = None
) -> None:
    """Write parts of an agent, with parameters rounded to bfloat16, as a checkpoint for playing and transfer.

    Networks that run in bfloat16 autocast round their parameters in any case.

    Args:
        parts: Parts of the agent, by name.
        config: The run's configuration.
        path: The file; its folder is created.
        shared: Fingerprints, by name, of the parts that the file omits because the built-in networks contain them.
    """
    shared = dict(shared or {})
    published = copy.deepcopy(nn.ModuleDict({name: part for name, part in parts.items() if name not in shared}))
    for parameter in published.parameters():
        parameter.data = parameter.data.to(torch.bfloat16)
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.run_checkpoint(published).save(path, metadata={"config": config, "shared": shared})


def fingerprints(parts: nn.ModuleDict, names: Collection[str], origin: Path) -> dict[str, str]:
    """Return the fingerprints of parts in bfloat16, after checking that the parts equal those of a published file.

    Args:
        parts: Parts of an agent.
        names: Names of the parts to compare.
        origin: The published file.

    Raises:
        ValueError: If a part differs, or is missing in the file.
    """
    rounded = nn.ModuleDict({name: copy.deepcopy(parts[name]) for name in names})
    checkpoint.load_parts(rounded, names, origin)
    marks = {name: fingerprint(_rounded(parts[name])) for name in names}
    if differing := [name for name in names if fingerprint(rounded[name]) != marks[name]]:
        raise ValueError(
            f"the policy was trained over {' and '.join(differing)} that differ from the built-in network "
            f"{origin.name}: train the policy again with pretrained=builtin"
        )
    return marks


def _rounded(part: nn.Module) -> nn.Module:
    """Return a copy with parameters rounded as in a published file."""
    part = copy.deepcopy(part)
    for parameter in part.parameters():
        parameter.data = parameter.data.to(torch.bfloat16).to(parameter.dtype)
    return part


def load_kept(parts: nn.ModuleDict, names: Collection[str], path: Path, origin: Callable[[], Path]) -> None:
    """Restore parts from a checkpoint file, and the parts that the file declares as shared from a built-in network.

    Args:
        parts: Parts of an agent.
        names: Names of the parts to restore.
        path: The file.
        origin: Returns the file of the built-in network.

    Raises:
        ValueError: If the file does not fit, or its policy was trained over parts that differ from the built-in
            network.
    """
    expected = {name: mark for name, mark in checkpoint.shared(path).items() if name in names}
    checkpoint.load_parts(parts, [name for name in names if name not in expected], path)
    if expected:
        take_shared(parts, expected, path, origin())


def take_shared(parts: nn.ModuleDict, expected: Mapping[str, str], path: Path, origin: Path) -> None:
    """Restore the parts that a published file omits, from a built-in network.

    Args:
        parts: Parts of an agent.
        expected: Fingerprints of the parts by name.
        path: The published file.
        origin: The file of the built-in network.

    Raises:
        ValueError: If the policy was trained over parts that differ from the built-in network.
    """
    checkpoint.load_parts(parts, expected, origin)
    if differing := [name for name, mark in expected.items() if fingerprint(parts[name]) != mark]:
        raise ValueError(
            f"{path} needs {' and '.join(differing)} that differ from {origin.name} in this version of torchrl-mcp: "
            "use the version of torchrl-mcp that published the file"
        )
