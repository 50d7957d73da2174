"""Worker processes: they live while they are needed, and their end is noticed."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import TypeVar

Result = TypeVar("Result")

INTERVAL = 0.5
"""Seconds between looks at the workers."""


def attend(task: Callable[[], Result], workers: Sequence[BaseProcess]) -> Result:
    """Return what ``task`` returns, which waits for ``workers``, unless one of them ends.

    The task runs in a thread, because what waits for a dead worker may wait for ever.

    Raises:
        ChildProcessError: If a worker ends.
    """
    outcome: Future[Result] = Future()
    thread = threading.Thread(target=_fulfil, args=(outcome, task), daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(INTERVAL)
        if not outcome.done():
            _require_alive(workers)
    if outcome.exception():
        _require_alive(workers)
    return outcome.result()


@contextmanager
def new_workers() -> Iterator[list[BaseProcess]]:
    """Give a list to which the processes are added that the block starts; if the block fails, they are ended."""
    others = set(multiprocessing.active_children())
    workers: list[BaseProcess] = []
    try:
        yield workers
    except BaseException:
        end(_started_beside(others))
        raise
    workers += _started_beside(others)


def end(workers: Sequence[BaseProcess]) -> None:
    """End those of ``workers`` that still live."""
    living = [process for process in multiprocessing.active_children() if process in workers]
    for process in living:
        process.kill()
    for process in living:
        process.join()


def end_with_parent() -> None:
    """Make this process end with the one that started it, however that ends, and leave interrupts to that one."""
    if multiprocessing.parent_process() is None:
        return
    # An interrupt goes to parent and children alike; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()


def _started_beside(others: set[BaseProcess]) -> list[BaseProcess]:
    """Return the child processes that are not among ``others``, in the order of their start."""
    return sorted(set(multiprocessing.active_children()) - others, key=lambda process: process.pid or 0)


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _fulfil(outcome: "Future[Result]", task: Callable[[], Result]) -> None:
    try:
        outcome.set_result(task())
    except BaseException as error:
        outcome.set_exception(error)


def _require_alive(workers: Sequence[BaseProcess]) -> None:
    for number, process in enumerate(workers):
        if (code := _exit_code(process)) is not None:
            how = (
                f"signal {signal.Signals(-code).name}" if code < 0 and sys.platform != "win32" else f"exit code {code}"
            )
            raise ChildProcessError(
                f"worker {number} of {len(workers)} (process {process.pid}) has ended by {how}. It may have said why "
                "above; SIGKILL often means that memory ran out: try fewer collector.num_workers or training.num_envs"
            )


def _exit_code(process: BaseProcess) -> int | None:
    """Return how a process ended, or None if it lives or TorchRL, which saw another one end, has ended it."""
    try:
        return process.exitcode
    except ValueError:
        return None
