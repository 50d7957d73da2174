import contextlib
import logging
import math
import socket
import threading
import time
from types import SimpleNamespace
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

pytest.importorskip("torchrl_mcp.viewer.studio", reason="needs MuJoCo Studio")

from torchrl_mcp.envs import Heading
from torchrl_mcp.viewer import studio
from torchrl_mcp.viewer.guard import guarded, refusal
from torchrl_mcp.viewer.panel import place
from torchrl_mcp.viewer.player import Player
from torchrl_mcp.viewer.steering import Steering
from torchrl_mcp.viewer.web import KEYS, BrowserEvent, BrowserInput, Pace, StudioApp, play_in_browser

IDLE = TensorDictModule(lambda goal: torch.zeros(len(goal), 17), in_keys=["goal"], out_keys=["action"])


class Stop(Exception):
    pass


class Brief(Player):
    """Stops the show when told to."""

    def __init__(self):
        super().__init__(IDLE, Heading("biped", 1, seed=0, num_threads=1))
        self.over, self.steps = threading.Event(), 0

    def step(self):
        if self.over.is_set():
            raise Stop
        super().step()
        self.steps += 1


@contextlib.contextmanager
def shown(player):
    """The address of a page that shows what a player does."""
    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]

    def run():
        with contextlib.suppress(Stop):
            play_in_browser(player, port=port)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield f"http://localhost:{port}"
    finally:
        player.over.set()
        thread.join(10)
    assert not thread.is_alive()


def fetched(address, seconds=20):
    """What is at an address that answers sooner or later."""
    end = time.monotonic() + seconds
    while True:
        try:
            with urlopen(address, timeout=5) as answer:
                return answer.read()
        except (URLError, ConnectionError):
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


def test_a_page_shows_the_character_while_it_plays(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))  # where Studio keeps its settings
    player = Brief()
    with shown(player) as address:
        page = fetched(f"{address}/")
        assert b"<canvas" in page
        assert page.rstrip().endswith(b"</html>")  # in full, although it is longer than Studio's
        assert page.index(b'name="viewport" content="width=device-width') < page.index(b"</head>")
        while player.steps < 3:
            time.sleep(0.01)
        served = fetched(f"{address}/model")  # of MuJoCo's own form, in which names are text
    model = player.env.simulation.model
    assert all(model.body(body).name.encode() in served for body in range(model.nbody))


def test_on_a_phone_the_panel_is_at_the_lower_edge_and_elsewhere_below_the_menu():
    corner, _, pivot = place(390, 844)
    assert (corner.y, pivot.y) == (844 - 48, 1)
    corner, _, pivot = place(1280, 844)
    assert (corner.y, pivot.y) == (48, 0)


def test_what_is_beside_the_simulation_is_drawn_where_it_is():
    player = Brief()
    app = StudioApp(Steering(player), distance=3.0)
    app.viewer, app.shapes = SimpleNamespace(extra_geoms=["an old one"]), player.shapes
    app.on_update(None)
    [geom], [shape] = app.viewer.extra_geoms, player.shapes
    np.testing.assert_allclose(geom.pos, shape.position, rtol=1e-6)
    np.testing.assert_allclose(geom.rgba, shape.colour)


def test_the_camera_follows_the_first_body():
    player = Brief()
    app = StudioApp(Steering(player), distance=3.0)
    app.viewer = SimpleNamespace(model=player.env.simulation.model, camera=mujoco.MjvCamera())
    app.align_camera()
    camera = app.viewer.camera
    assert (camera.type, camera.trackbodyid) == (mujoco.mjtCamera.mjCAMERA_TRACKING, 1)
    assert camera.distance == 3.0


def test_the_pace_is_what_the_controls_say():
    pace = Pace()
    assert (pace.paused, pace.speed) == (False, 1.0)
    pace.on_step_control(studio.messages.StepControlSnapshot(studio.sim.PauseState.NORMAL_PAUSED, 50.0, 0.0, 0.0))
    assert (pace.paused, pace.speed) == (True, 0.5)


def test_what_is_done_in_the_browser_is_done_to_the_player():
    steering = Steering(Brief())
    browser = BrowserInput(steering)
    browser.on_browser_event(BrowserEvent(lambda steering: steering.aim(1.0)))
    assert steering.direction == 1.0
    browser.on_browser_event(BrowserEvent(KEYS[studio.imgui.Key.LeftArrow]))
    assert steering.direction == pytest.approx(1.0 + math.radians(15))
    steering.step()
    browser.on_reset(studio.messages.ResetEvent(key=-1))
    assert steering.player.began


def test_the_page_is_for_this_machine_and_its_own_address_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    player = Brief()
    with shown(player) as address:
        fetched(f"{address}/")
        port = int(address.rpartition(":")[2])
        for headers in ({"Origin": "http://elsewhere.example"}, {"Host": "elsewhere.example"}):
            with pytest.raises(HTTPError, match="403"):
                urlopen(Request(f"{address}/model", headers=headers), timeout=5)
        assert urlopen(Request(f"{address}/", headers={"Origin": address}), timeout=5).status == 200
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as visitor, pytest.raises(OSError, match="refused"):
            visitor.connect(("127.0.0.2", port))  # what listens on every interface answers here as well


@pytest.mark.parametrize(
    ("host", "origin", "refused"),
    [
        ("localhost:8080", None, None),
        ("localhost:8080", "http://localhost:8080", None),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", None),
        ("localhost:8080", "http://elsewhere.example", "other sites"),
        ("localhost:8080", "http://localhost:9090", "other sites"),
        ("localhost:8080", "null", "other sites"),
        ("elsewhere.example:8080", "http://elsewhere.example:8080", "localhost"),
        ("192.0.2.7:8080", "http://192.0.2.7:8080", "localhost"),
        ("", None, "localhost"),
    ],
)
def test_requests_by_other_names_and_of_other_sites_are_refused(host, origin, refused):
    reason = refusal({"Host": host} | ({} if origin is None else {"Origin": origin}))
    assert reason is None if refused is None else refused in reason


@pytest.mark.parametrize("name", ["bind_public_socket", "serve"])
def test_no_page_is_opened_by_a_studio_that_cannot_be_guarded(monkeypatch, name):
    monkeypatch.delattr(studio.web_server, name)
    with pytest.raises(RuntimeError, match="--viewer window"):
        play_in_browser(Brief(), port=0)


def test_the_log_has_warnings_alone_while_the_viewer_is_open():
    with guarded():
        assert not studio.web_server.logger.isEnabledFor(logging.INFO)
    assert studio.web_server.logger.isEnabledFor(logging.INFO)
