"""Ray's workers that fail or end: commands say why."""

import subprocess
import sys
import time

import pytest
from sessions import living

from torchrl_mcp.training.ray_workers import working

exceptions = pytest.importorskip("ray.exceptions")

FAILING = """
import os

from torchrl_mcp.envs import Heading

os.environ.setdefault("MAIN", str(os.getpid()))


class Failing(Heading):
    def __init__(self, *arguments, **settings):
        if os.environ["MAIN"] != str(os.getpid()):
            raise RuntimeError("no room for another world")
        super().__init__(*arguments, **settings)
"""
"""A task that works in the main process and fails in a worker."""


def failed(cause):
    return exceptions.RayTaskError("next", f"Traceback ...\n  File ...\n{cause!r}", cause, actor_id="1")


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (failed(RuntimeError("the reason")), "the reason"),
        (failed(ValueError("the reason")).as_instanceof_cause(), "the reason"),
        (exceptions.ActorDiedError(failed(RuntimeError("the reason"))), "the reason"),
        (exceptions.ActorDiedError(), "memory"),
        (exceptions.OutOfMemoryError("a page of text"), "memory"),
    ],
)
def test_a_worker_that_fails_or_ends_is_explained_in_one_line(error, reason):
    with pytest.raises(ChildProcessError, match=reason) as raised, working():
        raise error
    assert "\n" not in str(raised.value)


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")
def test_a_training_whose_ray_workers_fail_while_they_start_ends_with_the_reason_and_leaves_none(tmp_path):
    (tmp_path / "failing.py").write_text(FAILING)
    (tmp_path / "own/task").mkdir(parents=True)
    task = "defaults: [heading, _self_]\nname: failing\ntransfer: {_target_: failing.Failing}\n"
    (tmp_path / "own/task/failing.yaml").write_text(task)
    settings = ["task=failing", "method=scratch", "preset=smoke", "logger=none", "run_dir=run", "collector=ray"]
    command = [sys.executable, "-m", "torchrl_mcp.commands.train", "--config-dir", "own", *settings]
    done = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    _, errors = done.communicate(timeout=300)
    assert done.returncode == 1
    assert "Traceback" not in errors
    (line,) = [line for line in errors.splitlines() if "no room for another world" in line]
    assert "worker" in line
    deadline = time.monotonic() + 10
    while living(done.pid) and time.monotonic() < deadline:
        time.sleep(0.5)
    assert not living(done.pid)
