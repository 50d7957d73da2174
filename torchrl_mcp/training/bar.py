"""The progress of training on a terminal."""

import sys
import time
from typing import Any, TextIO

from tqdm import tqdm

from torchrl_mcp.evaluation.bars import bar

QUIET = 60.0
"""Seconds between lines if there is no terminal."""


class TrainingBar:
    """Steps, speed, time left and a note on a training: a bar on a terminal, else a line every minute.

    Args:
        total: Environment steps of the training; the last batch may exceed it.
        done: Steps so far.
        shown: Whether to show anything.
        file: Output stream, standard error by default.
    """

    def __init__(self, total: int, done: int = 0, *, shown: bool = True, file: TextIO | None = None) -> None:
        self._file = file or sys.stderr
        self._total, self._done, self._first, self._shown = total, done, done, shown
        self._began = self._told = time.monotonic()
        self._note = ""
        form = "{n_fmt}/{total_fmt} {rate_fmt} {elapsed}<{remaining}{postfix}"
        self._bar: tqdm | None = None
        if shown and self._file.isatty():
            scale: dict[str, Any] = {"initial": min(done, total), "unit": " steps", "unit_scale": True}
            self._bar = bar(total, "", file=self._file, leave=True, form=form, width=80, **scale)

    def __enter__(self) -> "TrainingBar":
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def advance(self, steps: int, note: str = "") -> None:
        """Count a batch.

        Args:
            steps: Environment steps of the batch.
            note: What has been learned, such as a return; empty to keep showing the last.
        """
        self._done += steps
        self._note = note or self._note
        if self._bar is not None:
            self._bar.set_postfix_str(self._note, refresh=False)
            self._bar.update(min(self._done, self._total) - self._bar.n)
        elif self._shown and time.monotonic() - self._told >= QUIET:
            self._told = time.monotonic()
            print(self._line(), file=self._file, flush=True)

    def _line(self) -> str:
        speed = (self._done - self._first) / (self._told - self._began)
        left = f"{max(self._total - self._done, 0) / speed / 60:.0f} min left" if speed else ""
        parts = [f"{self._done:,} of {self._total:,} steps", f"{speed:,.0f} steps/s", left, self._note]
        return ", ".join(filter(None, parts))
