"""The lock of a run folder, which one process holds at a time and which ends with it, on POSIX and on Windows."""

import contextlib
import os
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

LOCK = ".lock"
"""The file that is locked. It says who holds it, and is there only while somebody does, or was killed."""

PAUSE = 0.05
"""Seconds between attempts."""

ATTEMPTS = 20
"""Before a lock counts as held: :func:`holder` takes it for a moment as well."""

if sys.platform == "win32":
    import msvcrt

    PLACE = 2**30
    """Of the byte that is locked: beyond all that is written, so that everybody can read that."""

    def _take(file: IO[str]) -> bool:
        os.lseek(file.fileno(), PLACE, os.SEEK_SET)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            os.lseek(file.fileno(), 0, os.SEEK_SET)
        return True

else:
    import fcntl

    def _take(file: IO[str]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


@contextmanager
def held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of a run folder while the block runs. Folders are made, and removed if nothing gets into them.

    Args:
        folder: The run folder.
        wait: Wait for whoever holds the lock.

    Raises:
        ValueError: If another process holds it, and this one does not wait.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / LOCK).open("a+") as file:
            if not _taken(file, folder, wait) or not _is_there(file, folder):
                continue
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
            try:
                yield
            finally:
                _remove(folder, made)
            return


def holder(folder: Path) -> str | None:
    """Return who holds the lock of a run folder, such as ``process 4711 on host``, or None."""
    try:
        with (folder / LOCK).open() as file:
            return None if _take(file) else file.read() or "another process"
    except FileNotFoundError:
        return None


def _taken(file: IO[str], folder: Path, wait: bool) -> bool:
    """Take the lock; return whether it is this process's now.

    Raises:
        ValueError: If another process holds it, and this one does not wait.
    """
    for _ in range(ATTEMPTS):
        if _take(file):
            return True
        time.sleep(PAUSE)
    if wait:
        return False
    file.seek(0)
    who = file.read() or "another process"
    raise ValueError(
        f"{folder} is in use: {who} is at work on it. Wait for that to end, or stop it, before you go on with this run"
    )


def _is_there(file: IO[str], folder: Path) -> bool:
    """Tell whether the folder still has this file: the former holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(folder / LOCK))
    except FileNotFoundError:
        return False


def _remove(folder: Path, made: Sequence[Path]) -> None:
    """Remove the file, and folders that were ``made``, the innermost first, if they hold nothing."""
    with contextlib.suppress(OSError):  # Windows keeps files that are open
        (folder / LOCK).unlink()
    with contextlib.suppress(OSError):
        for path in made:
            path.rmdir()
