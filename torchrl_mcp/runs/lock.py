"""The lock of a run folder, held by one process at a time and released when it ends, on POSIX and on Windows."""

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
"""The locked file. It contains the holder's name, and remains only if the holder was killed."""

PAUSE = 0.05
"""Seconds between attempts."""

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk without space, which say what to do."""

ATTEMPTS = 20
"""Number of attempts before a lock counts as held: :func:`holder` also takes it, briefly."""

if sys.platform == "win32":
    import msvcrt

    PLACE = 2**30
    """Offset of the locked byte: beyond the content, so that other processes can read the content."""

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

    def _take(file: IO[str], *, shared: bool = False) -> bool:  # over NFS, a file that is only read takes no other
        try:
            fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True


@contextmanager
def held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the lock of a run folder while the block runs, first without what killed processes have left there.

    Missing folders are created, and removed if they stay empty.

    Args:
        folder: The run folder.
        wait: Wait until the lock is free.

    Raises:
        ValueError: If another process holds the lock and ``wait`` is false, or the folder cannot be written.
    """
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    while True:
        with _opened(folder) as file:
            if not _taken(file, folder, wait) or not _is_there(file, folder):
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
        ValueError: If the folder cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return (folder / LOCK).open("a+")
    except OSError as error:
        if error.errno in FULL:
            raise
        raise ValueError(f"{folder} cannot be written ({error.strerror}): give another run_dir or run_root") from error


def holder(folder: Path) -> str | None:
    """Return the holder of a run folder's lock, such as ``process 4711 on host``, or None."""
    try:
        with (folder / LOCK).open() as file:
            return None if _take(file, shared=True) else file.read() or "another process"
    except FileNotFoundError:
        return None


def _taken(file: IO[str], folder: Path, wait: bool) -> bool:
    """Try to take the lock; return whether this process holds it.

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
    who = file.read() or "another process"
    raise ValueError(
        f"{folder} is in use by {who}: wait until this process ends, or stop it, before you continue the run"
    )


def _is_there(file: IO[str], folder: Path) -> bool:
    """Return whether the folder still has this file: the previous holder may have removed it."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(folder / LOCK))
    except FileNotFoundError:
        return False


def _remove(folder: Path, made: Sequence[Path]) -> None:
    """Remove the file and, innermost first, folders in ``made`` that are empty."""
    with contextlib.suppress(OSError):  # Windows cannot remove open files
        (folder / LOCK).unlink()
    with contextlib.suppress(OSError):
        for path in made:
            path.rmdir()
