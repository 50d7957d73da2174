"""Errors in motion files."""

from pathlib import Path


class MotionFormatError(ValueError):
    """An error in a motion file, with its position.

    Args:
        path: The file.
        message: Description of the error, and the remedy.
        line: Number of the line, from 1, if known.

    Example:
        >>> print(MotionFormatError("walk.bvh", "'one' is not a number: correct it", line=12))
        walk.bvh:12: 'one' is not a number: correct it
    """

    def __init__(self, path: str | Path, message: str, line: int | None = None) -> None:
        self.path = Path(path)
        self.line = line
        super().__init__(f"{path}: {message}" if line is None else f"{path}:{line}: {message}")


class MisreadError(MotionFormatError):
    """An error in a motion that can be read, but that no character can follow.

    Args:
        path: The file.
        finding: What is impossible.
        remedy: What to do about it.
    """

    def __init__(self, path: str | Path, finding: str, remedy: str) -> None:
        self.finding = finding
        super().__init__(path, f"{finding}: {remedy}")
