"""What is wrong with a motion file."""

from pathlib import Path


class MotionFormatError(ValueError):
    """A motion file that cannot be used, with the place where it goes wrong.

    Args:
        path: The file.
        message: What is wrong and what to do about it.
        line: Number of the line, from 1, where there is one to name.

    Example:
        >>> print(MotionFormatError("walk.bvh", "'one' is no number: correct it", line=12))
        walk.bvh:12: 'one' is no number: correct it
    """

    def __init__(self, path: str | Path, message: str, line: int | None = None) -> None:
        self.path, self.line = Path(path), line
        super().__init__(f"{path}: {message}" if line is None else f"{path}:{line}: {message}")
