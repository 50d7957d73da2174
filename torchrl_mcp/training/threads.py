"""Control of torch's threads."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Result = TypeVar("Result")


@contextmanager
def threads(number: int) -> Iterator[None]:
    """Let torch use ``number`` threads on the CPU while the block runs, and then as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def threads_kept() -> Iterator[None]:
    """Let torch have as many threads after the block as before it, whatever the block sets."""
    with threads(torch.get_num_threads()):
        yield


def side_by_side(tasks: Mapping[str, Callable[[], Result]]) -> dict[str, Result]:
    """Run tasks in parallel, each with its share of torch's threads, or in turn if there are too few threads.

    One thread for each of two networks is faster than two threads for every matrix product: the networks do not wait
    for each other at each operation, and Python's work for one overlaps with the products of the other.

    Args:
        tasks: Functions by name. They draw no random numbers and change no shared data.

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
