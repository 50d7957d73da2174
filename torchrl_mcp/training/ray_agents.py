"""Ray's agents: they end with the process that started Ray.

On Linux the kernel ends Ray's servers together with the process that started them. Ray's agents notice at once, but
wait a minute for a server to report to (``ray._private.utils.publish_error_to_driver``, whose 60 seconds no setting
changes). This module, run as a script without imports from the library, ends them sooner. On other systems Ray ends
them itself.
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
"""Name of the parent process of agents and workers."""

INTERVAL = 2.0
"""Seconds between searches for new agents."""

GRACE = 3.0
"""Seconds that agents get to end by themselves."""


@contextmanager
def watched() -> Iterator[None]:
    """When the block or this process ends, end the children of the Ray server that the block started."""
    if not hasattr(os, "pidfd_open"):
        yield
        return
    # In a new session, because an interrupt reaches all processes of this session.
    watcher = subprocess.Popen([sys.executable, __file__], stdin=subprocess.PIPE, start_new_session=True)
    assert watcher.stdin is not None
    try:
        yield
    finally:
        watcher.stdin.close()
        watcher.wait()


def watch(parent: int, pipe: int) -> None:
    """Wait until ``pipe`` closes, at the latest when ``parent`` ends; then end the agents that ``parent`` left."""
    found: dict[int, int] = {}
    while not select.select([pipe], [], [], INTERVAL)[0]:
        for agent in _agents(parent) - found.keys():
            with suppress(ProcessLookupError):
                found[agent] = os.pidfd_open(agent)  # stays valid for this process if its number is reused
    deadline = time.monotonic() + GRACE
    for descriptor in found.values():
        select.select([descriptor], [], [], max(deadline - time.monotonic(), 0.0))
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(descriptor, signal.SIGKILL)


def _agents(parent: int) -> set[int]:
    """Return the children of the Ray server that ``parent`` started."""
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
