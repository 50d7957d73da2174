import os
import signal
import subprocess
import sys
import time

import pytest
from refusals import refused

from torchrl_mcp.runs.processes import start, ticks

PARENT = """
import signal, sys, time
from torchrl_mcp.runs.processes import start
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell starts in the background
    print(start(time.sleep, 60).pid, flush=True)
    time.sleep(60)
"""


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_process_ends_with_its_parent_however_that_ends(tmp_path, how):
    (tmp_path / "parent.py").write_text(PARENT)
    parent = subprocess.Popen(
        [sys.executable, tmp_path / "parent.py"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    child = int(parent.stdout.readline())
    time.sleep(0.5)
    assert alive(child)
    parent.send_signal(how)
    parent.wait(timeout=60)
    deadline = time.monotonic() + 20
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(child)


def test_ticks_go_on_until_all_have_ended_and_come_once_more():
    processes = [start(time.sleep, 0.0), start(time.sleep, 1.0)]
    running = [any(process.is_alive() for process in processes) for _ in ticks(processes, 0.1)]
    assert running.count(True) > 1
    assert running[-1] is False


def test_a_failure_of_the_last_process_is_reported_even_if_it_ends_between_two_looks():
    process = start(sys.exit, "a reason")
    process.join()
    refused(lambda: list(ticks([process], 0.1)), "failed")


def test_a_failure_is_reported_while_others_still_run():
    processes = [start(time.sleep, 60.0), start(sys.exit, "a reason")]
    refused(lambda: list(ticks(processes, 0.1)), "failed")
    assert processes[0].is_alive()
    processes[0].terminate()
    processes[0].join()
