"""Functions that run side by side, each in its own process."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.process import BaseProcess
from typing import Any


def start(function: Callable[..., None], *args: Any) -> BaseProcess:
    """Call ``function`` in a new process, which does not outlive this one, however this one ends."""
    process = multiprocessing.get_context("spawn").Process(target=_call, args=(function, *args), daemon=True)
    process.start()
    return process


def ticks(processes: Sequence[BaseProcess], interval: float) -> Iterator[None]:
    """Yield every ``interval`` seconds while any of the processes runs, and once more after they have ended.

    Raises:
        ValueError: If a process fails; it has said why on the terminal.
    """
    while running := [process for process in processes if process.is_alive()]:
        yield
        running[0].join(interval)
        if any(process.exitcode for process in processes):
            raise ValueError("one of the processes has failed, for the reason above; nothing that is done is lost")
    yield


def _call(function: Callable[..., None], *args: Any) -> None:
    # An interrupt goes to parent and children alike; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        function(*args)
    except ValueError as error:
        sys.exit(str(error))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
