"""Worker processes: their end is noticed, and none stays behind."""

import multiprocessing
import subprocess
import sys
import threading
import time

import pytest

from torchrl_mcp.runs.processes import start
from torchrl_mcp.training.workers import attend, begun, end, new_workers

COMMAND = """
import multiprocessing, time
from torchrl_mcp.commands.train import main
if __name__ == "__main__":
    worker = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60,))
    worker.start()
    print(worker.pid, flush=True)
    time.sleep(60)
"""
"""A command line that imports what ``torchrl-mcp-train`` does, with a worker that sleeps in place of its imports."""


FAILING = """
import multiprocessing

from torchrl_mcp.envs import Heading


class Failing(Heading):
    def __init__(self, *arguments, **settings):
        if multiprocessing.parent_process() is not None:
            raise RuntimeError("no room for another world")
        super().__init__(*arguments, **settings)
"""
"""A task that works in the main process and fails in a worker."""


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
        with pytest.raises(ChildProcessError, match=r"worker 1 .*SIGKILL"):
            attend(for_ever, workers)
    finally:
        end(workers)
    assert time.monotonic() - began < 10
    assert not set(workers) & set(multiprocessing.active_children())


@pytest.mark.skipif(sys.platform == "win32", reason="needs a fork")
def test_workers_are_spawned_in_a_process_that_starts_others_otherwise_as_joblib_s_jobs_do():
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("fork", force=True)
    try:
        with new_workers() as workers:
            multiprocessing.Process(target=time.sleep, args=(60.0,)).start()
        assert type(workers[0]._popen).method == "spawn"
        assert multiprocessing.get_start_method() == "fork"
    finally:
        multiprocessing.set_start_method(before, force=True)
        end(workers)


def test_a_start_whose_worker_dies_without_a_word_is_given_up_within_seconds():
    def starting():
        worker = start(time.sleep, 60.0)
        time.sleep(0.5)
        worker.kill()
        for_ever()

    began = time.monotonic()
    with pytest.raises(ChildProcessError, match="SIGKILL"), new_workers():
        begun(starting)
    assert time.monotonic() - began < 20


def test_a_worker_that_died_before_anyone_looked_is_seen_although_another_still_starts():
    def starting():
        worker = start(time.sleep, 60.0)
        worker.kill()
        worker.join()
        assert worker not in multiprocessing.active_children()  # and from here on forgotten
        other = start(time.sleep, 60.0)
        for_ever()
        return worker, other

    began = time.monotonic()
    with pytest.raises(ChildProcessError, match=r"worker 0 .*SIGKILL"), new_workers():
        begun(starting)
    assert time.monotonic() - began < 20
    assert not multiprocessing.active_children()


def test_a_worker_that_closed_its_connection_is_named_by_how_it_ended():
    def starting():
        worker = start(time.sleep, 60.0)
        worker.kill()
        worker.join()
        raise RuntimeError("the connection was closed") from EOFError()

    with pytest.raises(ChildProcessError, match="SIGKILL"), new_workers():
        begun(starting)


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (RuntimeError("the reason"), ChildProcessError),
        (KeyError("the reason"), ChildProcessError),
        (MemoryError("the reason"), ChildProcessError),
        (ValueError("the reason"), ValueError),
    ],
)
def test_a_start_that_fails_says_why_in_an_error_that_commands_explain(error, raised):
    def starting():
        raise error

    with pytest.raises(raised, match="the reason"):
        begun(starting)
    assert begun(lambda: 3) == 3


def test_a_training_whose_workers_fail_while_they_start_ends_with_the_reason_in_one_line(tmp_path):
    (tmp_path / "failing.py").write_text(FAILING)
    (tmp_path / "own/task").mkdir(parents=True)
    task = "defaults: [heading, _self_]\nname: failing\ntransfer: {_target_: failing.Failing}\n"
    (tmp_path / "own/task/failing.yaml").write_text(task)
    settings = ["task=failing", "method=scratch", "preset=smoke", "logger=none", "run_dir=run"]
    settings += ["collector=processes", "collector.num_workers=2"]
    command = [sys.executable, "-m", "torchrl_mcp.commands.train", "--config-dir", "own", *settings]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "no room for another world" in line]
    assert "worker" in line


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
@pytest.mark.parametrize("seconds", [0.0, 1.0])
def test_a_worker_of_the_command_ends_with_it_also_before_its_own_imports_are_over(tmp_path, seconds):
    (tmp_path / "command.py").write_text(COMMAND)
    command = subprocess.Popen([sys.executable, tmp_path / "command.py"], stdout=subprocess.PIPE, text=True)
    assert int(command.stdout.readline()) != command.pid
    time.sleep(seconds)
    command.kill()
    command.wait()
    began = time.monotonic()
    assert command.stdout.read() == ""  # the worker has the other end of the pipe until it ends
    assert time.monotonic() - began < 40  # of the 60 that the worker would sleep
