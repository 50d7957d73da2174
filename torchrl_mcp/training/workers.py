"""Supervises worker processes: notices workers that end, ends all workers after a failure or with their parent."""

import multiprocessing
import os
import re
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from multiprocessing.process import BaseProcess, _dangling  # type: ignore[attr-defined]
from typing import TypeVar

Result = TypeVar("Result")

INTERVAL = 0.5
"""Seconds between checks of the workers."""

PATIENCE = 5.0
"""Seconds to wait for the reason of a worker that has ended."""


def attend(task: Callable[[], Result], workers: Sequence[BaseProcess]) -> Result:
    """Return the result of ``task``, which waits for ``workers``, or fail as soon as one of them ends.

    The task runs in a thread, because it may wait forever for a dead worker.

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


def begun(start: Callable[[], Result]) -> Result:
    """Return the result of ``start``, which starts workers, or fail as soon as one of them fails or ends.

    Raises:
        ChildProcessError: If a worker ends, or fails with an error other than the two below.
        OSError: If a worker or ``start`` raises this error.
        ValueError: If a worker or ``start`` raises this error.
    """
    earlier = _processes()
    outcome: Future[Result] = Future()
    thread = threading.Thread(target=_fulfil, args=(outcome, start), daemon=True)
    thread.start()
    workers: list[BaseProcess] = []
    while thread.is_alive():
        thread.join(INTERVAL / 10)
        workers += [process for process in _started_after(earlier) if process not in workers]
        try:
            _require_alive(workers)
        except ChildProcessError:
            thread.join(PATIENCE)  # a worker that fails sends the reason before it ends
            if not outcome.done():
                raise
    error = outcome.exception()
    if error is None or not isinstance(error, Exception) or isinstance(error, (OSError, ValueError)):
        return outcome.result()
    if isinstance(error.__cause__, EOFError):  # a worker ended without a reason, perhaps before the first check
        _require_alive(_started_after(earlier))
    raise failure("a worker failed while it started", error) from error


def failure(event: str, error: Exception) -> ChildProcessError:
    """Return an error with the last line of another error, whose message may be the whole traceback of a worker."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return ChildProcessError(f"{event}: {lines[-1].rstrip('.')}")


@contextmanager
def new_workers() -> Iterator[list[BaseProcess]]:
    """Yield a list that receives the processes which the block spawns; if the block fails, end the processes."""
    earlier = _processes()
    workers: list[BaseProcess] = []
    method = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("spawn", force=True)  # joblib sets another start method in its jobs
    try:
        yield workers
    except BaseException:
        end(_started_after(earlier))
        raise
    finally:
        multiprocessing.set_start_method(method, force=True)
    workers += _started_after(earlier)


def end(workers: Sequence[BaseProcess]) -> None:
    """End the ``workers`` that are still alive."""
    living = [process for process in multiprocessing.active_children() if process in workers]
    for process in living:
        process.kill()
    for process in living:
        process.join()


def end_with_parent() -> None:
    """End this process as soon as its parent has ended for any reason, and ignore interrupts."""
    if multiprocessing.parent_process() is None:
        return
    # An interrupt reaches the parent and all children; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()


def end_with_parent_while_starting() -> None:
    """End a process that ``multiprocessing`` is spawning as soon as its parent has ended, even during imports.

    The imports of a worker take seconds, and :func:`end_with_parent` takes effect only after them. On Windows this
    function does nothing.
    """
    if "--multiprocessing-fork" not in sys.orig_argv or sys.platform == "win32":
        return
    if pipe := re.search(r"pipe_handle=(\d+)", " ".join(sys.orig_argv)):
        # The parent may have ended already, and its process number may be in use again. The pipe is safe: its other end
        # closes when the parent ends.
        threading.Thread(target=_follow, args=(os.dup(int(pipe[1])),), daemon=True).start()


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Turn SIGTERM, which ``kill`` and schedulers send, into an interrupt during the block, so that it cleans up."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    previous_handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


def _processes() -> set[BaseProcess]:
    """Return the processes that this process has started, including ended ones that an object still refers to."""
    # active_children() would omit a process that ended before the first check.
    return {process for process in set(_dangling) if _number(process)}


def _started_after(earlier: set[BaseProcess]) -> list[BaseProcess]:
    """Return the processes of :func:`_processes` that are not among ``earlier``, in the order of their start."""
    return sorted(_processes() - earlier, key=_number)


def _number(process: BaseProcess) -> int:
    """Return the number of a process, or 0 if the process has not been started or has been closed."""
    try:
        return process.pid or 0
    except ValueError:
        return 0


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _follow(pipe: int) -> None:
    """End this process as soon as the other end of a pipe is closed."""
    hang_up = select.poll()
    hang_up.register(pipe, 0)
    hang_up.poll()
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
                f"worker {number} (process {process.pid}) has ended by {how}. The output above may give the reason. "
                "SIGKILL often means a lack of memory: reduce collector.num_workers or training.num_envs"
            )


def _exit_code(process: BaseProcess) -> int | None:
    """Return the exit code of a process, or None if it is alive, or if TorchRL closed it after another worker ended."""
    try:
        return process.exitcode
    except ValueError:
        return None
