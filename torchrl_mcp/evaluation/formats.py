"""Defines the file formats of films."""

from importlib.util import find_spec
from pathlib import Path

ENCODER = "imageio_ffmpeg"
"""Module that writes MP4 files; its package includes ffmpeg."""

EVERY = {".gif": 2, ".mp4": 1}
"""Control steps per picture, by the suffix of the file."""


def require_format(path: Path) -> None:
    """Check that the suffix of a file is a format of films that can be written.

    Raises:
        ValueError: If the suffix is unknown, or if it is ``.mp4`` and imageio-ffmpeg is not installed.
    """
    if path.suffix not in EVERY:
        raise ValueError(f"{path} must be the name of a film: end it with .gif or .mp4")
    if path.suffix == ".mp4" and find_spec(ENCODER) is None:
        raise ValueError(f"{path} needs imageio-ffmpeg: pip install 'torchrl-mcp[video]', or write a .gif")
