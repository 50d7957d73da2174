"""Worker processes: their end is noticed, and none stays behind."""

import multiprocessing
import subprocess
import sys
import threading
import time

import pytest

from torchrl_mcp.runs.processes import start
from torchrl_mcp.training.workers import attend, end, new_workers

COMMAND = """
import multiprocessing, time
from torchrl_mcp.cli.train import main
if __name__ == "__main__":
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    worker.start()
    print(worker.pid, flush=True)
    time.sleep(60)
"""
"""A command line that imports what ``torchrl-mcp-train`` does, with a worker that sleeps in place of its imports."""


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


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_worker_of_the_command_ends_with_it_also_before_its_own_imports_are_over(tmp_path):
    (tmp_path / "command.py").write_text(COMMAND)
    command = subprocess.Popen([sys.executable, tmp_path / "command.py"], stdout=subprocess.PIPE, text=True)
    assert int(command.stdout.readline()) != command.pid
    time.sleep(1.0)
    command.kill()
    command.wait()
    began = time.monotonic()
    assert command.stdout.read() == ""  # the worker has the other end of the pipe until it ends
    assert time.monotonic() - began < 20
