"""What a Ray server leaves behind is ended; Ray itself is killed in ``test_collectors.py``."""

import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from torchrl_mcp.training import ray_agents

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere Ray ends its agents itself")


@pytest.fixture
def shell(tmp_path):
    """Start a shell of a name, which ends after its only child."""

    def start(name):
        (tmp_path / name).symlink_to("/bin/sh")
        started.append(subprocess.Popen([tmp_path / name, "-c", "sleep 60; exit 7"]))
        return started[-1]

    started = []
    yield start
    for process in started:
        process.kill()
        process.wait()


def test_when_the_pipe_closes_the_children_of_the_server_are_ended_and_no_others(shell, monkeypatch):
    monkeypatch.setattr(ray_agents, "INTERVAL", 0.05)
    monkeypatch.setattr(ray_agents, "GRACE", 0.2)
    server, other = shell("raylet"), shell("other")
    reading, writing = os.pipe()
    watcher = threading.Thread(target=ray_agents.watch, args=(os.getpid(), reading))
    watcher.start()
    time.sleep(1.0)
    assert server.poll() is None
    os.close(writing)
    watcher.join()
    os.close(reading)
    assert server.wait(5) == 7
    assert other.poll() is None


def watchers():
    """Return the watchers that this process started."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parent = int(path.read_text().rpartition(") ")[2].split()[1])
            if parent == os.getpid() and ray_agents.__file__ in (path.parent / "cmdline").read_text():
                found.append(path.parent)
    return found


def test_the_watcher_ends_with_what_it_watches_over():
    with ray_agents.watched():
        deadline = time.monotonic() + 30
        while not watchers():  # a process has no command line for a moment after its start
            assert time.monotonic() < deadline
        assert len(watchers()) == 1
    assert not watchers()
