"""Locks a run folder for one process at a time, until the process ends, on POSIX and on Windows."""

import contextlib
import errno
import os
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from torchrl_mcp.training.run_folder import remove_leftovers

LOCK = ".lock"
"""The locked file. It names the process that holds the lock, and remains only if this process is killed."""

PAUSE = 0.05
"""Seconds between attempts to take the lock."""

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk without space, whose messages already name the remedy."""

ATTEMPTS = 20
"""Number of attempts to take the lock. One is not enough, because :func:`holder` also takes the lock briefly."""

if sys.platform == "win32":
    import msvcrt

    PLACE = 2**30
    """Offset of the locked byte, beyond the content, so that other processes can read the content."""

    def _take(file: IO[str], *, shared: bool = False) -> bool:
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

    def _take(file: IO[str], *, shared: bool = False) -> bool:
        # Over NFS, a file that is opened for reading can only be locked in shared mode.
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


@contextmanager
def hold(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of a run folder during the block, and remove unfinished files of killed processes first.

    Missing folders are created, and removed again if they stay empty.

    Args:
        folder: The run folder.
        wait: Whether to wait until the lock is free.

    Raises:
        ValueError: If another process holds the lock and ``wait`` is false, or the folder cannot be written.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    while True:
        with _opened(folder) as file:
            if not _taken(file, folder, wait) or not _is_current(file, folder):
                continue
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
            try:
                remove_leftovers(folder)
                yield
            finally:
                _remove(folder, made)
            return


def _opened(folder: Path) -> IO[str]:
    """Open the file of the lock.

    Raises:
        ValueError: If the folder cannot be created or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return (folder / LOCK).open("a+")
    except OSError as error:
        if error.errno in FULL:
            raise
        raise ValueError(f"{folder} cannot be written ({error.strerror}): give another run_dir or run_root") from error


def holder(folder: Path) -> str | None:
    """Return the process that holds the lock of a run folder, such as ``process 4711 on host``, or None."""
    try:
        with (folder / LOCK).open() as file:
            return None if _take(file, shared=True) else file.read() or "another process"
    except FileNotFoundError:
        return None


def _taken(file: IO[str], folder: Path, wait: bool) -> bool:
    """Try to take the lock, and return whether this process has taken it.

    Raises:
        ValueError: If another process holds the lock and ``wait`` is false.
    """
    for _ in range(ATTEMPTS):
        if _take(file):
            return True
        time.sleep(PAUSE)
    if wait:
        return False
    file.seek(0)
    process = file.read() or "another process"
    raise ValueError(
        f"{folder} is in use by {process}: wait until this process ends, or stop it, before you continue the run"
    )


def _is_current(file: IO[str], folder: Path) -> bool:
    """Return whether the folder still contains this file, which the previous holder may have removed."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(folder / LOCK))
    except FileNotFoundError:
        return False


def _remove(folder: Path, made: Sequence[Path]) -> None:
    """Remove the file of the lock, and the folders in ``made`` that are empty, innermost first."""
    with contextlib.suppress(OSError):  # Windows cannot remove open files
        (folder / LOCK).unlink()
    with contextlib.suppress(OSError):
        for path in made:
            path.rmdir()
