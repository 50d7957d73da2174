import contextlib

import mujoco
import mujoco.viewer
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from torchrl_mcp.envs import Heading
from torchrl_mcp.viewer.player import Player, Weights
from torchrl_mcp.viewer.window import LENGTH, as_text, play_in_window

GATED = TensorDictModule(
    lambda goal: (torch.zeros(len(goal), 17), torch.tensor([[1.0, 0.5]])),
    in_keys=["goal"],
    out_keys=["action", "gates"],
)


class Window:
    """What MuJoCo's window shows while it is open for some steps."""

    def __init__(self, steps):
        self.cam, self.texts, self.seen = mujoco.MjvCamera(), [], []
        self.steps, self.lock = steps, contextlib.nullcontext

    def open(self, model, data, **_):
        self.model, self.data, self.user_scn = model, data, mujoco.MjvScene(model, 100)
        return contextlib.nullcontext(self)

    def is_running(self):
        return len(self.seen) < self.steps

    def set_texts(self, text):
        self.texts.append(text)

    def sync(self):
        self.seen.append((self.data.time, self.data.qpos.copy(), self.user_scn.ngeom))


@pytest.fixture
def window(monkeypatch):
    window = Window(3)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(mujoco.viewer, "launch_passive", window.open)
    return window


def test_the_window_shows_every_control_step_until_it_is_closed(window):
    player = Player(GATED, Heading("biped", 1, seed=0, num_threads=1))
    play_in_window(player)
    times, states, shapes = zip(*window.seen, strict=True)
    np.testing.assert_allclose(times, [1 / 30, 2 / 30, 3 / 30], rtol=1e-6)
    np.testing.assert_allclose(states[-1], player.data.qpos)
    assert shapes == (1, 1, 1)  # the arrow, and not one more with every step
    assert window.texts[-1][2:] == as_text(Weights("gates", [1.0, 0.5]))
    assert window.cam.trackbodyid == 1


def test_weights_are_strokes_beside_the_numbers_of_their_primitives():
    numbers, strokes = as_text(Weights("gates", [0.0, 0.5, 1.0]))
    assert numbers.split("\n") == ["gates", "1", "2", "3"]
    assert [len(line) for line in strokes.split("\n")] == [0, 0, LENGTH / 2, LENGTH]
