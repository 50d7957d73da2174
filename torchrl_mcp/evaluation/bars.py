"""Progress bars on a terminal, all of one width."""

import sys
from typing import Any, TextIO

from tqdm import tqdm

WIDTH = 60
"""Width of a bar in columns."""


def bar(
    total: int | None, label: str, *, file: TextIO | None = None, leave: bool = False, form: str = "", **kwargs: Any
) -> tqdm:
    """Return a bar of :data:`WIDTH` columns, which is hidden without a terminal.

    Args:
        total: Number of steps, None if unknown.
        label: Text before the bar.
        file: The terminal, standard error by default.
        leave: Keep the bar when it is full.
        form: Text after the bar, in ``tqdm``'s ``bar_format``.
        **kwargs: Passed on to ``tqdm``.
    """
    return tqdm(
        desc=label,
        total=total,
        ncols=WIDTH,
        file=file or sys.stderr,
        leave=leave,
        disable=None,
        bar_format=f"{{desc}} {{percentage:3.0f}}% |{{bar}}| {form or '{elapsed}<{remaining}'}",
        **kwargs,
    )
