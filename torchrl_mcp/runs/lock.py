"""A file's lock, which ends with the process that holds it, however that ends: on POSIX, and on Windows."""

import sys
from pathlib import Path
from typing import IO

if sys.platform == "win32":
    import msvcrt
    import os
    import time

    PLACE = 2**30
    """Of the byte that is locked: beyond all that is written, so that everybody can read that."""
    PAUSE = 0.1
    """Seconds between attempts."""

    def hold(file: IO[str]) -> None:
        """Lock an open file until it is closed, waiting for whoever holds it."""
        while not _take(file):
            time.sleep(PAUSE)

    def is_held(path: Path) -> bool:
        """Tell whether a process holds the lock of a file."""
        with path.open() as file:
            return not _take(file)

    def _take(file: IO[str]) -> bool:
        os.lseek(file.fileno(), PLACE, os.SEEK_SET)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def hold(file: IO[str]) -> None:
        """Lock an open file until it is closed, waiting for whoever holds it."""
        fcntl.flock(file, fcntl.LOCK_EX)

    def is_held(path: Path) -> bool:
        """Tell whether a process holds the lock of a file."""
        with path.open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False
