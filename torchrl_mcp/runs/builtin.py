"""Finds the networks that come with the library: primitives and gates of generated motions, and gates for tasks."""

from pathlib import Path

FOLDER = Path(__file__).parents[1] / "networks"
"""Folder of the built-in networks."""

PREFIX = "builtin:"
"""Prefix of the names of built-in networks on a command line; the name of the character follows."""


def builtin(method: str, character: str, task: str | None = None) -> Path:
    """Return the checkpoint file of a built-in network: a method's pre-training, or its gate for a task.

    Raises:
        ValueError: If the library has no such network.
    """
    path = FOLDER / f"{'-'.join(filter(None, (method, character, task)))}.torchrl"
    if not path.is_file():
        available = ", ".join(file.stem for file in sorted(FOLDER.glob("*.torchrl")) if task or not has_task(file))
        raise ValueError(
            f"no network for method={method} and character={character}{f' and task={task}' if task else ''} comes with "
            f"the library, only {available}: pre-train a network with stage=pretrain and give its run folder instead"
        )
    return path


def has_task(path: Path) -> bool:
    """Return whether the file of a built-in network is a gate for a task."""
    return path.stem.count("-") > 1


def names() -> list[str]:
    """Return the names of MCP's built-in networks, as on a command line."""
    return sorted(f"{PREFIX}{path.stem.removeprefix('mcp-')}" for path in FOLDER.glob("mcp-*.torchrl"))


def locate(checkpoint: str) -> Path:
    """Return the run folder or checkpoint file that a command line names.

    Args:
        checkpoint: A path, ``builtin:CHARACTER`` or ``builtin:CHARACTER-TASK``.

    Raises:
        ValueError: If there is no such built-in network or file.
    """
    if checkpoint in names():
        return FOLDER / f"mcp-{checkpoint.removeprefix(PREFIX)}.torchrl"
    if checkpoint.startswith(PREFIX):
        raise ValueError(f"no {checkpoint} comes with the library: give one of {', '.join(names())}")
    if not Path(checkpoint).exists():
        raise ValueError(
            f"there is no {checkpoint}: give a run folder, a checkpoint file, {PREFIX}CHARACTER or "
            f"{PREFIX}CHARACTER-TASK"
        )
    return Path(checkpoint)
