"""File formats of films."""

from importlib.util import find_spec
from pathlib import Path

ENCODER = "imageio_ffmpeg"
"""Module that writes MP4; it brings its own ffmpeg."""

EVERY = {".gif": 2, ".mp4": 1}
"""Control steps per picture, by the file's suffix."""


def require_format(path: Path) -> None:
    """Check that a film can be written to a file.

    Raises:
        ValueError: If the suffix is unknown, or is ``.mp4`` and imageio-ffmpeg is not installed.
    """
    if path.suffix not in EVERY:
        raise ValueError(f"{path} must be the name of a film: end it with .gif or .mp4")
    if path.suffix == ".mp4" and find_spec(ENCODER) is None:
        raise ValueError(f"{path} needs imageio-ffmpeg: pip install 'torchrl-mcp[video]', or write a .gif")
