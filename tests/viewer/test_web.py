import asyncio
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

pytest.importorskip("mujoco.experimental.studio", reason="needs MuJoCo Studio as MuJoCo 3.17 has it")

from mujoco.experimental.studio.web import web_server

from torchrl_mcp.envs import Heading
from torchrl_mcp.viewer.guard import HERE, guarded, refusal
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
        served = tmp_path / "served.mjb"
        while player.steps < 3:
            time.sleep(0.01)
        served.write_bytes(fetched(f"{address}/model"))
    assert mujoco.MjModel.from_binary_path(str(served)).nq == player.env.simulation.model.nq


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
    from mujoco.experimental.studio import messages, sim

    pace = Pace()
    assert (pace.paused, pace.speed) == (False, 1.0)
    pace.on_step_control(messages.StepControlSnapshot(sim.PauseState.NORMAL_PAUSED, 50.0, 0.0, 0.0))
    assert (pace.paused, pace.speed) == (True, 0.5)


def test_what_is_done_in_the_browser_is_done_to_the_player():
    from mujoco.experimental.dear_imgui import dear_imgui as imgui
    from mujoco.experimental.studio import messages

    steering = Steering(Brief())
    browser = BrowserInput(steering)
    browser.on_browser_event(BrowserEvent(lambda steering: steering.aim(1.0)))
    assert steering.direction == 1.0
    browser.on_browser_event(BrowserEvent(KEYS[imgui.Key.LeftArrow]))
    assert steering.direction == pytest.approx(1.0 + math.radians(15))
    steering.step()
    browser.on_reset(messages.ResetEvent(key=-1))
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
    ("path", "host", "origin", "address", "refused"),
    [
        ("/", "localhost:8080", None, "127.0.0.1", None),
        ("/ui?sid=1", "localhost:8080", "http://localhost:8080", "127.0.0.1", None),
        ("/drop", "127.0.0.1:8080", "http://127.0.0.1:8080", "::ffff:127.0.0.1", None),
        ("/state", "192.0.2.7:8080", "http://192.0.2.7:8080", "192.0.2.9", None),
        ("/ui", "192.0.2.7:8080", "http://192.0.2.7:8080", "192.0.2.9", "only the viewer's own machine"),
        ("/drop?sid=1", "[2001:db8::7]:8080", "http://[2001:db8::7]:8080", "2001:db8::9", "own machine"),
        ("/ui", "localhost:8080", "http://elsewhere.example", "127.0.0.1", "other sites"),
        ("/ui", "localhost:8080", "http://localhost:9090", "127.0.0.1", "other sites"),
        ("/ui", "localhost:8080", "null", "127.0.0.1", "other sites"),
        ("/model", "elsewhere.example:8080", "http://elsewhere.example:8080", "127.0.0.1", "not the viewer's"),
        ("/model", "", None, "127.0.0.1", "not the viewer's"),
    ],
)
def test_who_may_what(path, host, origin, address, refused):
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    reason = refusal(path, headers, address)
    assert reason is None if refused is None else refused in reason


class Connection:
    """A browser's connection to the page at 192.0.2.7."""

    local_address = ("192.0.2.7", 8080)

    def __init__(self, address, *messages):
        self.remote_address, self.messages, self.heard, self.closed = (address, 50000), messages, [], None

    async def __aiter__(self):
        for message in self.messages:
            yield message

    async def close(self, code, reason):
        self.closed = reason


def attendant(monkeypatch, handler):
    """The handler of connections that Studio would call on a guarded page."""
    monkeypatch.setattr(web_server, "serve", lambda attend, **settings: attend)
    with guarded(HERE):
        return web_server.serve(handler, process_request=None)


@pytest.mark.parametrize(
    ("address", "heard"),
    [
        ("127.0.0.1", ["state_ack", "force_control", b"input", "heartbeat"]),
        ("192.0.2.7", ["state_ack", "force_control", b"input", "heartbeat"]),  # this machine, by its own address
        ("192.0.2.9", ["state_ack", "heartbeat"]),
    ],
)
def test_a_visitor_cannot_ask_for_control(monkeypatch, address, heard):
    async def handler(connection):
        connection.heard.extend([message async for message in connection])

    connection = Connection(address, "state_ack", "force_control", b"input", "heartbeat")
    asyncio.run(attendant(monkeypatch, handler)(connection))
    assert connection.heard == heard


def test_visitors_leave_room_for_this_machine(monkeypatch):
    async def crowd():
        end, inside = asyncio.Event(), []

        async def handler(connection):
            inside.append(connection.remote_address[0])
            await end.wait()

        attend = attendant(monkeypatch, handler)
        guests = [Connection(f"192.0.2.{100 + i}") for i in range(20)]
        tasks = [asyncio.create_task(attend(one)) for one in (*guests, Connection("127.0.0.1"))]
        await asyncio.sleep(0)
        end.set()
        await asyncio.gather(*tasks)
        await attend(Connection("192.0.2.200"))  # in the place of one who left
        return inside, [one.closed for one in guests]

    inside, closed = asyncio.run(crowd())
    assert inside == [*(f"192.0.2.{100 + i}" for i in range(6)), "127.0.0.1", "192.0.2.200"]
    assert closed == [None] * 6 + ["too many visitors"] * 14


@pytest.mark.parametrize("host", ["192.0.2.1", "nobody.invalid", "1.2.3"])
def test_a_host_that_is_not_this_machines_is_refused(host):
    said = rf"host={host} is no address of this machine: pass one, or 0\.0\.0\.0"
    with pytest.raises(ValueError, match=said), guarded(host):
        pass


def test_no_page_is_opened_by_a_version_of_mujoco_that_nobody_has_tried(monkeypatch):
    monkeypatch.setattr(mujoco, "__version__", "3.18.0")
    with pytest.raises(RuntimeError, match=r"MuJoCo 3\.18\.0 is not known: install mujoco 3\.17"):
        play_in_browser(Brief(), port=0)


def test_the_log_has_warnings_alone_while_the_viewer_is_open():
    with guarded(HERE):
        assert not web_server.logger.isEnabledFor(logging.INFO)
    assert web_server.logger.isEnabledFor(logging.INFO)
