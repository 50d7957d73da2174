"""Networks that come with the library: primitives and gates that follow its generated motions."""

from pathlib import Path

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
        ValueError: If the networks do not come with the library, or nothing has that name.
    """
    if checkpoint.startswith(PREFIX):
        return builtin("mcp", checkpoint.removeprefix(PREFIX))
    if not Path(checkpoint).exists():
        raise ValueError(f"there is no {checkpoint}: give a run folder, a checkpoint file, or {PREFIX}CHARACTER")
    return Path(checkpoint)
