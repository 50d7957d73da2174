"""Checkpoints for others: the policy alone, as small as those that come with the library."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from torchrl_mcp.training.checkpoint import run_checkpoint


def publish(parts: nn.ModuleDict, config: Mapping[str, Any], path: Path) -> None:
    """Write parts of an agent, parameters rounded to bfloat16, as a checkpoint to play or to transfer from.

    Networks that run in bfloat16 autocast round their parameters anyway.

    Args:
        parts: What to write, by name.
        config: The run's configuration.
        path: The file; its folder is made.
    """
    rounded = copy.deepcopy(parts)
    for parameter in rounded.parameters():
        parameter.data = parameter.data.to(torch.bfloat16)
    path.parent.mkdir(parents=True, exist_ok=True)
    run_checkpoint(rounded).save(path, metadata={"config": config})
