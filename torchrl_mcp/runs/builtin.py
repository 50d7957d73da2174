"""Networks that come with the library: primitives and gates that follow its generated motions."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from torchrl_mcp.training.checkpoint import run_checkpoint

FOLDER = Path(__file__).parents[1] / "networks"

PREFIX = "builtin:"
"""What a command line says before the name of a character, for the networks of MCP that come with the library."""


def builtin(method: str, character: str) -> Path:
    """Return the checkpoint file of a method's pre-training that comes with the library.

    Raises:
        ValueError: If there is none.
    """
    path = FOLDER / f"{method}-{character}.torchrl"
    if not path.is_file():
        there = ", ".join(sorted(file.stem for file in FOLDER.glob("*.torchrl")))
        raise ValueError(
            f"no network for method={method} and character={character} comes with the library, only {there}: "
            "pre-train one with stage=pretrain and give its run folder instead"
        )
    return path


def locate(checkpoint: str) -> Path:
    """Return the run folder or checkpoint file that a command line names, which may be ``builtin:CHARACTER``.

    Raises:
        ValueError: If the networks do not come with the library.
    """
    is_builtin = checkpoint.startswith(PREFIX)
    return builtin("mcp", checkpoint.removeprefix(PREFIX)) if is_builtin else Path(checkpoint)


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
