"""Worker processes: their end is noticed, and none stays behind."""

import multiprocessing
import threading
import time

import pytest

from torchrl_mcp.runs.processes import start
from torchrl_mcp.training.workers import attend, end, new_workers


def for_ever():
    threading.Event().wait()


def test_what_a_task_returns_or_raises_comes_back_while_all_workers_live():
    with new_workers() as workers:
        start(time.sleep, 60.0)
    try:
        assert attend(lambda: 3, workers) == 3
        with pytest.raises(KeyError, match="a reason"):
            attend(lambda: {}["a reason"], workers)
    finally:
        end(workers)


def test_a_task_that_waits_for_a_dead_worker_is_given_up_within_seconds_and_the_worker_is_named():
    with new_workers() as workers:
        start(time.sleep, 60.0)
        start(time.sleep, 60.0)
    threading.Timer(0.5, workers[1].kill).start()
    began = time.monotonic()
    try:
        with pytest.raises(ChildProcessError, match=r"worker 1 of 2 .* has ended by signal SIGKILL"):
            attend(for_ever, workers)
    finally:
        end(workers)
    assert time.monotonic() - began < 10
    assert not set(workers) & set(multiprocessing.active_children())


def test_workers_of_a_start_that_fails_are_ended_and_others_are_left_alone():
    bystander = start(time.sleep, 60.0)
    started = []

    def fail():
        with new_workers():
            started.append(start(time.sleep, 60.0))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not started[0].is_alive()
    assert bystander.is_alive()
    end([bystander])
