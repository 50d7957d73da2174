"""Controls how many threads torch uses."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Result = TypeVar("Result")


@contextmanager
def threads(number: int) -> Iterator[None]:
    """Let torch use ``number`` threads on the CPU during the block; afterwards restore the number."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def threads_kept() -> Iterator[None]:
    """Restore the number of torch's threads after a block that may change the number."""
    with threads(torch.get_num_threads()):
        yield


def side_by_side(tasks: Mapping[str, Callable[[], Result]]) -> dict[str, Result]:
    """Run tasks in parallel, each with an equal share of torch's threads; with too few threads, run them in turn.

    Two networks with one thread each are faster than two threads for every matrix product: the threads do not wait for
    each other after each operation, and Python's work for one network overlaps with the products of the other.

    Args:
        tasks: Functions by name. At most one function may draw random numbers, and none may change shared data.

    Returns:
        The result of each task, by name.
    """
    share = torch.get_num_threads() // len(tasks)
    if share < 1 or len(tasks) == 1:
        return {name: task() for name, task in tasks.items()}
    workers = ThreadPoolExecutor(len(tasks), initializer=torch.set_num_threads, initargs=(share,))
    with threads(share), workers:
        begun = {name: workers.submit(task) for name, task in tasks.items()}
        return {name: future.result() for name, future in begun.items()}
