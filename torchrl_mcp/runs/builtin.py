"""Networks that come with the library: primitives and gates that follow its generated motions, and gates for tasks."""

from pathlib import Path

FOLDER = Path(__file__).parents[1] / "networks"

PREFIX = "builtin:"
"""What a command line says before the name of a character, for the networks of MCP that come with the library."""


def builtin(method: str, character: str, task: str | None = None) -> Path:
    """Return a checkpoint file that comes with the library: of a method's pre-training, or of its gate for a task.

    Raises:
        ValueError: If there is none.
    """
    path = FOLDER / f"{'-'.join(filter(None, (method, character, task)))}.torchrl"
    if not path.is_file():
        there = ", ".join(file.stem for file in sorted(FOLDER.glob("*.torchrl")) if task or not has_task(file))
        raise ValueError(
            f"no network for method={method} and character={character}{f' and task={task}' if task else ''} comes with "
            f"the library, only {there}: pre-train one with stage=pretrain and give its run folder instead"
        )
    return path


def has_task(path: Path) -> bool:
    """Tell whether a file that comes with the library is a gate for a task."""
    return path.stem.count("-") > 1


def names() -> list[str]:
    """Return what command lines may write for MCP's networks that come with the library."""
    return sorted(f"{PREFIX}{path.stem.removeprefix('mcp-')}" for path in FOLDER.glob("mcp-*.torchrl"))


def locate(checkpoint: str) -> Path:
    """Return the run folder or checkpoint file that a command line names.

    Args:
        checkpoint: Its path, ``builtin:CHARACTER`` or ``builtin:CHARACTER-TASK``.

    Raises:
        ValueError: If the networks do not come with the library, or nothing has that name.
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
