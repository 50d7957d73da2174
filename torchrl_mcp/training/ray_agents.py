"""Ray's agents: they end with the process that started Ray.

On Linux the kernel ends Ray's servers with the process that started them. Their agents notice at once, but then wait a
minute for a server to report that to (``ray._private.utils.publish_error_to_driver``, whose 60 seconds no setting
changes). Run as a script, which imports nothing of the library, this module waits with them and ends them. Elsewhere
Ray does so itself.
"""

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SERVER = "raylet"
"""The process whose children are the agents and workers."""

INTERVAL = 2.0
"""Seconds between looks for new ones."""

GRACE = 3.0
"""Seconds that they have to end by themselves."""


@contextmanager
def watched() -> Iterator[None]:
    """End the children of the Ray server that the block starts when the block, or this process, has ended."""
    if not hasattr(os, "pidfd_open"):
        yield
        return
    # In a session of its own, because an interrupt goes to all processes of this one's.
    watcher = subprocess.Popen([sys.executable, __file__], stdin=subprocess.PIPE, start_new_session=True)
    assert watcher.stdin is not None
    try:
        yield
    finally:
        watcher.stdin.close()
        watcher.wait()


def watch(parent: int, pipe: int) -> None:
    """Wait until ``pipe`` is closed, which its other end is by the death of ``parent``; then end what it has left."""
    found: dict[int, int] = {}
    while not select.select([pipe], [], [], INTERVAL)[0]:
        for agent in _agents(parent) - found.keys():
            with suppress(ProcessLookupError):
                found[agent] = os.pidfd_open(agent)  # stands for this process alone, whoever gets its number later
    deadline = time.monotonic() + GRACE
    for descriptor in found.values():
        select.select([descriptor], [], [], max(deadline - time.monotonic(), 0.0))
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(descriptor, signal.SIGKILL)


def _agents(parent: int) -> set[int]:
    """Return the children of the Ray server that ``parent`` has started."""
    processes = [found for path in Path("/proc").glob("[0-9]*/stat") if (found := _process(path))]
    servers = {process for process, name, of in processes if (name, of) == (SERVER, parent)}
    return {process for process, _, of in processes if of in servers}


def _process(stat: Path) -> tuple[int, str, int] | None:
    """Return number, name and parent of a process, or None if it has ended."""
    with suppress(OSError):
        number, _, rest = stat.read_text().partition(" (")
        name, _, fields = rest.rpartition(") ")
        return int(number), name, int(fields.split()[1])
    return None


if __name__ == "__main__":
    watch(os.getppid(), sys.stdin.fileno())
