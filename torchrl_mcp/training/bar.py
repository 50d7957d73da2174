"""The progress of training on a terminal."""

import math
import sys
import time
from typing import TextIO

from tqdm import tqdm

from torchrl_mcp.evaluation.bars import bar

QUIET = 60.0
"""Seconds between lines if there is no terminal."""


class TrainingBar:
    """Steps, time left and return of a training: a bar on a terminal, else a line every minute.

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
        self._return = math.nan
        form = "{n_fmt}/{total_fmt} {elapsed}<{remaining}{postfix}"
        self._bar: tqdm | None = None
        if shown and self._file.isatty():
            self._bar = bar(
                total, "", file=self._file, leave=True, form=form, initial=min(done, total), unit_scale=True
            )

    def __enter__(self) -> "TrainingBar":
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()

    def advance(self, steps: int, normalised_return: float) -> None:
        """Count a batch.

        Args:
            steps: Environment steps of the batch.
            normalised_return: Mean over episodes that ended in the batch; NaN if none did, to keep showing the last.
        """
        self._done += steps
        if math.isfinite(normalised_return):
            self._return = normalised_return
        shown = "" if math.isnan(self._return) else f"return {self._return:.3f}"
        if self._bar is not None:
            self._bar.set_postfix_str(shown, refresh=False)
            self._bar.update(min(self._done, self._total) - self._bar.n)
        elif self._shown and time.monotonic() - self._told >= QUIET:
            self._told = time.monotonic()
            print(self._line(shown), file=self._file, flush=True)

    def _line(self, shown: str) -> str:
        speed = (self._done - self._first) / (self._told - self._began)
        left = f"{max(self._total - self._done, 0) / speed / 60:.0f} min left" if speed else ""
        parts = [f"{self._done:,} of {self._total:,} steps", f"{speed:,.0f} steps/s", left, shown]
        return ", ".join(filter(None, parts))
