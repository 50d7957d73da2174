"""The lock by which others see that a run is alive."""

import ast
import errno
import os
import runpy
import socket
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from refusals import refused

from torchrl_mcp.runs import lock

ROOT = Path(__file__).parents[2]
POSIX_ONLY = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
HOLDER = """
import pathlib, sys
from torchrl_mcp.runs import lock
with lock.hold(pathlib.Path(sys.argv[1])):
    print(flush=True)
    input()
"""


@pytest.fixture
def windows(monkeypatch):
    """The module as Windows runs it, over a lock of bytes that belongs to whoever opened the file."""
    owners = {}

    def locking(descriptor, mode, count):
        place = os.fstat(descriptor).st_ino, os.lseek(descriptor, 0, os.SEEK_CUR), count
        if place in owners and owners[place] != descriptor:
            raise PermissionError
        owners[place] = descriptor

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    monkeypatch.setattr(sys, "platform", "win32")
    return SimpleNamespace(**runpy.run_path(lock.__file__))


@pytest.fixture
def other(tmp_path):
    """A process that holds the lock of ``tmp_path / "run"``."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, tmp_path / "run"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    process.stdout.readline()
    yield process
    process.kill()
    process.wait()


def test_a_lock_is_held_by_one_who_is_named_until_that_process_dies(other, tmp_path):
    run = tmp_path / "run"
    assert lock.holder(run) == f"process {other.pid} on {socket.gethostname()}"
    refused(lambda: lock.hold(run).__enter__(), f"process {other.pid}")
    other.kill()
    other.wait()
    assert lock.holder(run) is None
    with lock.hold(run):
        assert lock.holder(run) == f"process {os.getpid()} on {socket.gethostname()}"
    assert lock.holder(run) is None


@pytest.mark.parametrize("end", ["kill", "communicate"])
def test_a_lock_that_is_waited_for_is_one_that_others_see(other, tmp_path, end):
    threading.Timer(2.5, getattr(other, end)).start()  # whoever is not killed removes the file
    with lock.hold(tmp_path / "run", wait=True):
        assert other.wait() != 0
        assert lock.holder(tmp_path / "run") == f"process {os.getpid()} on {socket.gethostname()}"


def test_folders_that_stay_empty_do_not_stay(tmp_path):
    (tmp_path / "old").mkdir()
    with lock.hold(tmp_path / "old" / "new" / "run"):
        pass
    assert list((tmp_path / "old").iterdir()) == []
    with lock.hold(tmp_path / "run"):
        (tmp_path / "run" / "config.yaml").touch()
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["config.yaml"]


@pytest.mark.skipif(sys.platform == "win32", reason="flock is of POSIX")
def test_who_looks_takes_a_lock_that_a_file_opened_for_reading_may_have_over_nfs(tmp_path, monkeypatch):
    import fcntl

    def flock(file, operation, real=fcntl.flock):
        writable = fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY
        if operation & fcntl.LOCK_EX and not writable:
            raise OSError(errno.EBADF, "Bad file descriptor")  # flock(2), NFS details
        real(file, operation)

    monkeypatch.setattr(fcntl, "flock", flock)
    with lock.hold(tmp_path):
        assert lock.holder(tmp_path) == f"process {os.getpid()} on {socket.gethostname()}"
    assert lock.holder(tmp_path) is None


def test_who_looks_does_not_keep_the_one_who_comes_out(tmp_path):
    ended = threading.Event()

    def look():
        while not ended.is_set():
            lock.holder(tmp_path / "run")

    watchers = [threading.Thread(target=look) for _ in range(3)]
    for watcher in watchers:
        watcher.start()
    try:
        for _ in range(50):
            with lock.hold(tmp_path / "run"):
                pass
    finally:
        ended.set()


def test_on_windows_a_lock_is_held_by_the_one_who_took_it_and_who_that_is_can_be_read(windows, tmp_path):
    with windows.hold(tmp_path):
        assert (tmp_path / windows.LOCK).read_text().startswith("process ")
        assert windows.holder(tmp_path).startswith("process ")
    assert windows.holder(tmp_path) is None


def test_nothing_but_the_lock_imports_what_only_posix_has():
    users = set()
    for path in [file for folder in ("torchrl_mcp", "envs", "conf") for file in (ROOT / folder).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            if POSIX_ONLY & set(names):
                users.add(path.name)
    assert users == {"lock.py"}
