"""Makes a small disk that is full from time to time, for ``soak.py``."""

import random
import resource
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FULL, FREE = (5.0, 15.0), (90.0, 180.0)
"""Minimum and maximum seconds for which the disk is full, and for which it has space."""


class Disk:
    """A small disk that is full from time to time.

    Args:
        folder: Folder at which the disk is mounted.
        pace: Factor on all durations.
    """

    def __init__(self, folder: Path, pace: float) -> None:
        mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
        self.mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
        self.kind = "tmpfs of 16 MB" if self.mounted else "RLIMIT_FSIZE"
        self._filler = folder / "filler"
        self._pace = pace
        self._full = False
        self._next = time.monotonic() + pace * random.uniform(*FREE)

    def pass_time(self, process: "subprocess.Popen[bytes]") -> None:
        """Fill or empty the disk if it is time to do so; without a mounted disk, limit the files of the process."""
        if time.monotonic() < self._next:
            return
        self._full = not self._full
        self._next = time.monotonic() + self._pace * random.uniform(*(FULL if self._full else FREE))
        if not self.mounted:
            limit = 2**15 if self._full else resource.RLIM_INFINITY
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        elif self._full:
            with suppress(OSError), self._filler.open("wb", buffering=0) as file:
                while file.write(bytes(2**16)):
                    pass
        else:
            self._filler.unlink()


@contextmanager
def small_disk(pace: float) -> Iterator[tuple[Path, Disk]]:
    """Yield a folder on a small disk, and the disk."""
    with tempfile.TemporaryDirectory() as name:
        disk = Disk(Path(name), pace)
        try:
            yield Path(name), disk
        finally:
            if disk.mounted:
                subprocess.run(["umount", name], check=True)
