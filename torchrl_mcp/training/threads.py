"""How torch's threads are shared out."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Result = TypeVar("Result")


@contextmanager
def threads(number: int) -> Iterator[None]:
    """Give torch ``number`` threads on the CPU, and afterwards as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def side_by_side(tasks: Mapping[str, Callable[[], Result]]) -> dict[str, Result]:
    """Do tasks at the same time, each with its share of torch's threads, or in turn where there are not enough.

    A thread of its own for each of two networks beats two threads for every matrix product: neither waits for the other
    at each operation, and what Python does for one is done beside the products of the other.

    Args:
        tasks: What to do, by name. Tasks share nothing that one of them changes, and draw no random numbers.

    Returns:
        What each returns.
    """
    share = torch.get_num_threads() // len(tasks)
    if share < 1 or len(tasks) == 1:
        return {name: task() for name, task in tasks.items()}
    workers = ThreadPoolExecutor(len(tasks), initializer=torch.set_num_threads, initargs=(share,))
    with threads(share), workers:
        begun = {name: workers.submit(task) for name, task in tasks.items()}
        return {name: future.result() for name, future in begun.items()}
