import contextlib
import math
import sys

import mujoco
import mujoco.viewer
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from torchrl_mcp.envs import Dribble, Heading
from torchrl_mcp.viewer.player import Player, Weights
from torchrl_mcp.viewer.steering import Steering
from torchrl_mcp.viewer.window import LENGTH, Keyboard, apply_mouse, as_text, play_in_window, require_display

GATED = TensorDictModule(
    lambda goal: (torch.zeros(len(goal), 17), torch.tensor([[1.0, 0.5]])),
    in_keys=["goal"],
    out_keys=["action", "gates"],
)


class Window:
    """What MuJoCo's window shows while it is open for some steps."""

    def __init__(self, steps, pressed=()):
        self.cam, self.texts, self.seen = mujoco.MjvCamera(), [], []
        self.steps, self.lock, self.perturb = steps, contextlib.nullcontext, mujoco.MjvPerturb()
        self.pressed = dict(pressed)  # by the number of pictures before it

    def open(self, model, data, key_callback, **_):
        self.press = key_callback
        self.model, self.data, self.user_scn = model, data, mujoco.MjvScene(model, 100)
        return contextlib.nullcontext(self)

    def is_running(self):
        return len(self.seen) < self.steps

    def set_texts(self, text):
        self.texts.append(text)

    def sync(self):
        self.seen.append((self.data.time, self.data.qpos.copy(), self.user_scn.ngeom))
        if key := self.pressed.get(len(self.seen)):
            self.press(key)


@pytest.fixture
def opened(monkeypatch):
    """Plays in a window for a while."""
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("glfw.init", lambda: True)

    def play(window, player):
        monkeypatch.setattr(mujoco.viewer, "launch_passive", window.open)
        play_in_window(player)
        return window

    return play


def player(task=Heading, **settings):
    return Player(GATED, task("biped", 1, seed=0, num_threads=1, **settings))


def test_the_window_shows_every_control_step_until_it_is_closed(opened):
    walker = player()
    window = opened(Window(3), walker)
    times, states, shapes = zip(*window.seen, strict=True)
    np.testing.assert_allclose(times, [1 / 30, 2 / 30, 3 / 30], rtol=1e-6)
    np.testing.assert_allclose(states[-1], walker.data.qpos)
    assert shapes == (1, 1, 1)  # the arrow, and not one more with every step
    assert window.texts[-1][2:] == as_text(Weights("gates", [1.0, 0.5]))
    assert window.cam.trackbodyid == 1


def test_keys_pause_go_on_turn_and_begin_anew(opened):
    space, left, backspace = ord(" "), 263, 259
    walker = player(max_turn=0.0)
    window = opened(Window(7, {1: space, 3: space, 4: left, 6: backspace}), walker)
    times = [round(30 * time) for time, *_ in window.seen]
    assert times == [1, 1, 1, 2, 3, 4, 1]
    [(tail, tip)] = walker.env.arrows(0)
    assert math.degrees(math.atan2(*(tip - tail)[1::-1])) == pytest.approx(15)


def test_the_slowest_speed_reacts_within_a_second():
    keyboard = Keyboard(Steering(player()))
    for _ in range(20):
        keyboard.press(ord("-"))
    keyboard.execute()
    assert 1 / 30 / keyboard.speed < 1


def test_what_the_mouse_drags_is_pushed_and_where_it_chose_the_ground_the_target_goes():
    ball = player(Dribble)
    steering, model = Steering(ball), ball.env.simulation.model
    data, hand = mujoco.MjData(model), mujoco.MjvPerturb()
    mujoco.mj_forward(model, data)
    hand.localpos[:] = 2.0, 1.0, 0.0
    apply_mouse(steering, model, data, hand)
    assert steering.place == (2.0, 1.0)
    pushed = ball.env.simulation.state["xfrc_applied"][0]
    assert not pushed.any()
    torso = model.body("torso").id
    hand.select, hand.active, hand.localmass = torso, int(mujoco.mjtPertBit.mjPERT_TRANSLATE), 1.0
    hand.localpos[:], hand.refselpos[:] = 0.0, data.xpos[torso] + [0.0, 0.5, 0.0]
    apply_mouse(steering, model, data, hand)
    force = pushed[torso, :3].numpy()
    assert force[1] > 1.0  # towards the hand
    assert np.abs(force[[0, 2]]).max() < 1e-6 * force[1]
    assert not np.delete(pushed.numpy(), torso, axis=0).any()


def test_weights_are_strokes_beside_the_numbers_of_their_primitives():
    numbers, strokes = as_text(Weights("gates", [0.0, 0.5, 1.0]))
    assert numbers.split("\n") == ["gates", "1", "2", "3"]
    assert [len(line) for line in strokes.split("\n")] == [0, 0, LENGTH / 2, LENGTH]


@pytest.mark.skipif(sys.platform != "linux", reason="DISPLAY is Linux's")
def test_a_display_that_does_not_open_is_named_with_what_works_without(monkeypatch):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(RuntimeError, match=r"DISPLAY=:987 .*--viewer web"):
        require_display()
