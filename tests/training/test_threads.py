"""Torch's threads are shared out, and given back."""

import threading

import pytest
import torch

from torchrl_mcp.training.threads import side_by_side, threads


@pytest.fixture(autouse=True)
def _two_threads():
    with threads(2):
        yield


def test_two_tasks_run_at_the_same_time_with_a_thread_of_torch_each():
    meeting = threading.Barrier(2)

    def meet():
        meeting.wait(timeout=10)  # raises unless both are here at once
        return torch.get_num_threads()

    assert side_by_side({"actor": meet, "critic": meet}) == {"actor": 1, "critic": 1}
    assert torch.get_num_threads() == 2


def test_with_one_thread_of_torch_tasks_run_in_turn_where_they_are_called():
    order = []

    def task(name):
        order.append((name, threading.get_ident()))

    with threads(1):
        side_by_side({name: lambda name=name: task(name) for name in "ab"})
    assert order == [("a", threading.get_ident()), ("b", threading.get_ident())]


def test_a_single_task_keeps_all_threads():
    assert side_by_side({"critic": torch.get_num_threads}) == {"critic": 2}


def test_an_error_in_a_task_reaches_the_caller_and_gives_the_threads_back():
    def fail():
        raise FloatingPointError("diverged")

    with pytest.raises(FloatingPointError, match="diverged"):
        side_by_side({"actor": fail, "critic": list})
    assert torch.get_num_threads() == 2
