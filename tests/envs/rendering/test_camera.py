import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
import torch
from refusals import refused

from torchrl_mcp.envs import Holdout
from torchrl_mcp.envs.rendering.camera import Camera


@pytest.fixture(scope="module")
def env():
    env = Holdout(2, (0.0, 0.0), seed=0, num_threads=1)
    env.reset()
    try:
        env.render(width=32, height=32)
    except (RuntimeError, mujoco.FatalError) as error:
        pytest.skip(str(error))
    yield env
    env.close()


def red(picture):
    """Columns of the arrow's pixels."""
    colour = picture.long()
    return ((colour[..., 0] > 120) & (colour[..., 1] < 60) & (colour[..., 2] < 60)).nonzero()[:, 1]


def test_a_picture_has_the_size_asked_for_and_shows_something(env):
    picture = env.render(1, width=320, height=240)
    assert picture.shape == (240, 320, 3)
    assert picture.dtype == torch.uint8
    assert picture.float().std() > 10


def test_pictures_may_be_larger_than_the_models_buffer(env):
    assert env.render(width=800, height=600).shape == (600, 800, 3)


def test_drawing_does_not_disturb_the_simulation(env):
    before = env.get_state()
    env.render(0, width=32, height=32)
    assert (env.get_state() == before).all()


def test_the_arrow_points_where_the_goal_does(env):
    env.episode["goal"][0], env.episode["goal"][1] = torch.tensor([1.0, 0.0]), torch.tensor([-1.0, 0.0])
    right, left = (red(env.render(index, width=320, height=240)).float().mean() for index in (0, 1))
    assert left < 160 < right


def test_an_unknown_simulation_is_refused(env):
    refused(lambda: env.render(2), "index=2")


DRAW_TWICE = """
import os, tensordict, torchrl.envs
for library in "disable", "glfw":
    if not os.fork():
        os.environ["MUJOCO_GL"] = library
        from torchrl_mcp.envs import Holdout
        for _ in range(2):
            env = Holdout(1, (0, 1))
            env.reset()
            try:
                env.render()
            except RuntimeError as error:
                print(library, error, flush=True)
        os._exit(0)
    print(library, "ended with", os.wait()[1], flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks a process that has imported torch")
def test_without_opengl_or_a_display_the_error_names_what_to_install_and_does_not_end_the_process(tmp_path):
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    result = subprocess.run(
        [sys.executable, "-c", DRAW_TWICE], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    for library in ("disable", "glfw"):
        first, again, end = (line for line in result.stdout.splitlines() if line.startswith(library))
        assert first == again
        assert "MuJoCo found no OpenGL" in first
        assert "libosmesa6" in first
        assert end == f"{library} ended with 0"


def test_pictures_of_many_sizes_hold_one_opengl_context_at_a_time(env, monkeypatch):
    closed, close = [], Camera.close
    monkeypatch.setattr(Camera, "close", lambda camera: closed.append(close(camera)))
    for others, width in enumerate((40, 48, 40), start=1):
        assert env.render(width=width, height=24).shape == (24, width, 3)
        assert len(closed) == others
    env.render(width=40, height=24)
    assert len(closed) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_pictures_of_many_sizes_take_the_memory_of_one(env):
    def memory():
        return int(re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024

    env.render(width=480, height=480)
    one = memory()
    for width in range(482, 490, 2):
        env.render(width=width, height=480)
    # MiB. 60 sizes took 11 more than one, and 6,600 when each kept its context.
    assert memory() - one < 200
