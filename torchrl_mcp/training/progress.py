"""Counts the steps of a run, measures the time of its sections, and shows the progress on standard error."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TextIO

from torch import nn
from tqdm import tqdm

from torchrl_mcp.evaluation.bars import bar
from torchrl_mcp.evaluation.wording import duration

QUIET = 60.0
"""Seconds between lines where the output is not a terminal."""

BRIEF = 120.0
"""Trainings that take fewer seconds than this get no estimate."""

FIRST = 2.0
"""Seconds of collected batches on which the estimate is based."""


@dataclass
class Progress:
    """The progress of a run, which every checkpoint stores.

    Attributes:
        iteration: Iterations so far.
        frames: Environment steps so far.
        seconds: Wall-clock seconds of all iterations.
    """

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0

    def state_dict(self) -> dict[str, float]:
        """Return the counters."""
        return dict(vars(self))

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the counters."""
        vars(self).update(state)


@dataclass
class Stopwatch:
    """Measures wall-clock seconds by section. The time outside all sections is overhead."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, section: str) -> Iterator[None]:
        """Add the time of a block to a section."""
        start = time.perf_counter()
        yield
        self.add(section, time.perf_counter() - start)

    def add(self, section: str, seconds: float) -> None:
        """Add seconds to a section."""
        self.seconds[section] = self.seconds.get(section, 0.0) + seconds

    def watch(self, section: str, module: nn.Module) -> None:
        """Add the time of every forward pass of ``module`` to a section.

        On a GPU, this is only the time to start the forward pass, because the GPU computes asynchronously.
        """
        starts: list[float] = []
        module.register_forward_pre_hook(lambda *_: starts.append(time.perf_counter()))
        module.register_forward_hook(lambda *_: self.add(section, time.perf_counter() - starts.pop()))


class TrainingBar:
    """Shows steps, speed, remaining time and a note: as a bar on a terminal, elsewhere as a line every minute.

    Args:
        total: Environment steps of the training; the last batch may exceed this number.
        done: Environment steps so far.
        shown: Whether to show anything.
        file: Output stream, standard error by default.
    """

    def __init__(self, total: int, done: int = 0, *, shown: bool = True, file: TextIO | None = None) -> None:
        self._file = file or sys.stderr
        self._total = total
        self._done = done
        self._first = done
        self._shown = shown
        self._began = time.monotonic()
        self._last_line = self._began
        self._note = ""
        self._second: tuple[float, int] | None = None  # time and steps at the beginning of the second batch
        self._estimated = not shown
        form = "{n_fmt}/{total_fmt} {rate_fmt} {elapsed}<{remaining}{postfix}"
        self._bar: tqdm | None = None
        if shown and self._file.isatty():
            scale: dict[str, Any] = {"initial": min(done, total), "unit": " steps", "unit_scale": True}
            self._bar = bar(total, "", file=self._file, leave=True, form=form, width=80, **scale)

    def __enter__(self) -> "TrainingBar":
        """Return the bar."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bar, which stays on the terminal."""
        if self._bar is not None:
            self._bar.close()

    def advance(self, steps: int, note: str = "") -> None:
        """Count a batch.

        Args:
            steps: Environment steps of the batch.
            note: A short result, such as the mean return; if empty, the last note stays.
        """
        self._done += steps
        self._note = note or self._note
        self._estimate()
        if self._bar is not None:
            self._bar.set_postfix_str(self._note, refresh=False)
            self._bar.update(min(self._done, self._total) - self._bar.n)
        elif self._shown and time.monotonic() - self._last_line >= QUIET:
            self._last_line = time.monotonic()
            print(self._line(), file=self._file, flush=True)

    def _estimate(self) -> None:
        """Print once how long the training will take.

        The first batch does not count, because it also prepares what later batches reuse.
        """
        if self._estimated:
            return
        now = time.monotonic()
        if self._second is None:
            self._second = now, self._done
            return
        began, done = self._second
        if now - began < FIRST or self._done == done:
            return
        self._estimated = True
        remaining = self._total - self._done
        seconds = remaining * (now - began) / (self._done - done)
        if seconds >= BRIEF:
            line = (
                f"about {duration(seconds)} for {remaining:,} steps on this machine; "
                "for a shorter run, set training.total_frames=N"
            )
            tqdm.write(line, file=self._file) if self._bar is not None else print(line, file=self._file, flush=True)

    def _line(self) -> str:
        speed = (self._done - self._first) / (self._last_line - self._began)
        remaining = f"{duration(max(self._total - self._done, 0) / speed)} left" if speed else ""
        done = f"{min(self._done, self._total):,} of {self._total:,} steps"
        return ", ".join(filter(None, [done, f"{speed:,.0f} steps/s", remaining, self._note]))
