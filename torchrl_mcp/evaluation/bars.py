"""Progress bars on a terminal."""

import sys
from typing import Any, TextIO

from tqdm import tqdm

WIDTH = 60
"""Columns of most bars."""


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
    """Return a bar, which is hidden without a terminal.

    Args:
        total: Number of steps, None if unknown.
        label: Text before the bar.
        file: The terminal, standard error by default.
        leave: Keep the bar when it is full.
        form: Text after the bar, in ``tqdm``'s ``bar_format``.
        width: Columns of bar and texts.
        **kwargs: Passed on to ``tqdm``.
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
