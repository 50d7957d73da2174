"""Counts the steps of a run, and measures the time of its sections."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from torch import nn


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
        """Add the time of every forward pass of ``module`` to a section."""
        starts: list[float] = []
        module.register_forward_pre_hook(lambda *_: starts.append(time.perf_counter()))
        module.register_forward_hook(lambda *_: self.add(section, time.perf_counter() - starts.pop()))
