"""Runs functions in parallel, each in its own process."""

import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.process import BaseProcess
from typing import Any

from torchrl_mcp.training.workers import end_with_parent


def start(function: Callable[..., None], *args: Any) -> BaseProcess:
    """Call ``function`` in a new process, which ends when this process ends for any reason."""
    process = multiprocessing.get_context("spawn").Process(target=_call, args=(function, *args), daemon=True)
    process.start()
    return process


def ticks(processes: Sequence[BaseProcess], interval: float) -> Iterator[None]:
    """Yield every ``interval`` seconds while any process runs, and once more after all have ended.

    Raises:
        ValueError: If a process fails; the process prints the reason to standard error.
    """
    while True:
        running = [process for process in processes if process.is_alive()]
        if any(process.exitcode for process in processes):
            raise ValueError("a process has failed for the reason above; finished work is kept")
        yield
        if not running:
            return
        running[0].join(interval)


def _call(function: Callable[..., None], *args: Any) -> None:
    end_with_parent()
    try:
        function(*args)
    except ValueError as error:
        sys.exit(str(error))
