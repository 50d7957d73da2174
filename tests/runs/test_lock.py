"""The lock by which others see that a run is alive."""

import ast
import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchrl_mcp.runs import lock

ROOT = Path(__file__).parents[2]
POSIX_ONLY = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
HOLDER = "import sys; from torchrl_mcp.runs import lock; f = open(sys.argv[1]); lock.hold(f); print(); input()"


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


def test_a_lock_is_held_until_its_process_dies(tmp_path):
    file = tmp_path / "log"
    file.touch()
    assert not lock.is_held(file)
    holder = subprocess.Popen([sys.executable, "-c", HOLDER, file], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    holder.stdout.readline()
    assert lock.is_held(file)
    holder.kill()
    holder.wait()
    assert not lock.is_held(file)


def test_on_windows_a_lock_is_held_by_the_one_who_took_it_and_leaves_the_text_readable(windows, tmp_path):
    file = tmp_path / "log"
    file.write_text("begun\n")
    with file.open("a") as held:
        windows.hold(held)
        assert windows.is_held(file)
        held.write("done\n")
    assert file.read_text() == "begun\ndone\n"


def test_nothing_but_the_lock_imports_what_only_posix_has():
    users = set()
    for path in [file for folder in ("torchrl_mcp", "envs", "conf") for file in (ROOT / folder).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            if POSIX_ONLY & set(names):
                users.add(path.name)
    assert users == {"lock.py"}
