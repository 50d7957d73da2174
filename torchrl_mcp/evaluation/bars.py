"""Progress bars on a terminal."""

import sys
from typing import Any, TextIO

from tqdm import tqdm

WIDTH = 60
"""Width of a bar with its texts in characters, unless another width is given."""


def bar(
    total: int | None,
    label: str,
    *,
    file: TextIO | None = None,
    leave: bool = False,
    form: str = "",
    width: int = WIDTH,
    **kwargs: Any,
) -> tqdm:
    """Return a progress bar, which is hidden if the output is not a terminal.

    Args:
        total: Number of steps, or None if unknown.
        label: Text before the bar.
        file: Output stream, standard error by default.
        leave: Whether the bar stays on the terminal when it is full.
        form: Text after the bar, in the format of ``tqdm``'s ``bar_format``.
        width: Width of the bar with its texts in characters.
        **kwargs: Further arguments of ``tqdm``.
    """
    return tqdm(
        desc=label,
        total=total,
        ncols=width,
        file=file or sys.stderr,
        leave=leave,
        disable=None,
        bar_format=f"{{desc}} {{percentage:3.0f}}% |{{bar}}| {form or '{elapsed}<{remaining}'}",
        **kwargs,
    )
