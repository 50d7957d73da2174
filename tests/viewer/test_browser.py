"""Steering in a real browser: ``pip install playwright``, and Chromium by ``apt-get install chromium``.

MuJoCo Studio draws one viewer a process, so the tests need one each: ``pytest -n 3 tests/viewer/test_browser.py``.
"""

import contextlib
import io
import math
import shutil
import threading
import time

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule, TensorDictSequential

pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
pytest.importorskip("torchrl_mcp.viewer.studio", reason="needs MuJoCo Studio")

from playwright import sync_api as playwright

from torchrl_mcp.envs import Dribble
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.policies import restore
from torchrl_mcp.viewer.player import Player
from torchrl_mcp.viewer.web import play_in_browser

CHROMIUM = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "google-chrome"])), None)
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed: apt-get install chromium"),
    pytest.mark.slow,  # the viewer runs in real time, beside nothing else
]

PATIENCE = 90.0
"""Seconds: without a GPU a browser draws a picture in one or more."""

LONG = 2000
"""Milliseconds between what the mouse does, for the same reason."""

WIDTH, HEIGHT = 560, 440

SHOWN = []
"""The player that this process has shown."""

GATED = TensorDictSequential(
    TensorDictModule(lambda goal: torch.tensor([[0.2, 0.8]]), in_keys=["goal"], out_keys=["gates"]),
    TensorDictModule(lambda gates: torch.zeros(1, 17), in_keys=["gates"], out_keys=["action"]),
)


class Stop(Exception):
    pass


class Show(Player):
    """A player that stops when told to."""

    def __init__(self, policy, env):
        super().__init__(policy, env)
        self.over, self.steps, self.pushed = False, 0, 0.0

    def step(self):
        self.pushed = max(self.pushed, float(self.env.simulation.state["xfrc_applied"].abs().max()))
        super().step()
        self.steps += 1

    @property
    def data(self):
        if self.over:
            raise Stop
        return super().data


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        # Chromium's sandbox does not start for root, as in containers; WebGL by the processor where there is no GPU.
        flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield browser
        browser.close()


@pytest.fixture
def visit(browser, monkeypatch, tmp_path, capfd):
    """Opens the page of a player."""
    monkeypatch.setenv("HOME", str(tmp_path))  # where Studio keeps its settings
    opened = []

    def visit(player):
        if SHOWN:
            pytest.skip("MuJoCo Studio draws one viewer a process: pytest -n 3 tests/viewer/test_browser.py")
        SHOWN.append(player)

        def run():
            with contextlib.suppress(Stop):
                play_in_browser(player, port=0)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        opened.append((player, thread, page := browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})))
        wait(lambda: player.steps > 0)
        said = capfd.readouterr().out
        drawn = []
        page.on("console", lambda message: drawn.append("First remote draw frame" in message.text))
        page.goto(next(word.strip(",") for word in said.split() if word.startswith("http")))
        wait(lambda: any(drawn), page)
        page.wait_for_timeout(2000)
        return page

    yield visit
    for player, thread, page in opened:
        page.close()
        player.over = True
        thread.join(10)
        assert not thread.is_alive()


def wait(condition, page=None):
    """Until a condition holds, or fail."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        page.wait_for_timeout(100) if page else time.sleep(0.1)


def target(player):
    """Where the target is. Tensors are read alone: the thread of the player computes what else MuJoCo says."""
    return player.env.simulation.outputs["xpos"][0, player.env.simulation.model.body("target").id, :2]


def hold(page, key, condition):
    """Hold a key until a condition holds."""
    page.keyboard.down(key)
    wait(condition, page)
    page.keyboard.up(key)
    page.wait_for_timeout(LONG)


def move(page, x, y):
    page.mouse.move(x, y)
    page.wait_for_timeout(LONG)


def click(page, x, y):
    move(page, x, y)
    page.mouse.down()
    page.wait_for_timeout(2 * LONG)
    page.mouse.up()


def stands_still(player, page):
    steps = player.steps
    page.wait_for_timeout(500)
    return player.steps == steps


def test_what_is_done_in_the_browser_reaches_the_player(visit):
    still = Dribble("biped", 1, seed=0, num_threads=1, terminate_on_fall=False, max_episode_steps=10**6)
    player = Show(GATED, still)
    page, state = visit(player), player.env.simulation.state

    before = target(player).clone()  # a click on the ground places the target
    click(page, WIDTH - 60, HEIGHT - 80)
    wait(lambda: (target(player) != before).any(), page)
    assert torch.linalg.vector_norm(target(player) - player.env.simulation.outputs["xpos"][0, 1, :2]) < 4.0
    assert player.pushed == 0.0

    move(page, WIDTH / 2, HEIGHT / 2 + 10)  # a body that is dragged is pushed, until it is let go
    page.mouse.down()
    page.wait_for_timeout(LONG)
    page.mouse.move(WIDTH / 2 + 60, HEIGHT / 2)
    wait(lambda: player.pushed > 1.0, page)
    page.mouse.up()
    wait(lambda: not state["xfrc_applied"].any(), page)

    hold(page, "ArrowDown", lambda: player.pinned)  # primitives act alone, one after another
    move(page, 60, 122)  # a bar that is held pins its gate
    page.mouse.down()
    wait(lambda: player.pinned.get(0) not in (0.0, 1.0, None), page)
    page.mouse.move(102, 122)
    wait(lambda: player.pinned[0] == pytest.approx(0.5, abs=0.05), page)
    page.mouse.up()

    move(page, WIDTH / 2, HEIGHT - 80)
    hold(page, " ", lambda: stands_still(player, page))
    hold(page, "Backspace", lambda: state["time"][0] == 0.0)


def test_the_humanoid_walks_to_a_click_and_stands_there_and_obeys_another_click_arrow_keys_and_a_stop(visit):
    changes = {"curriculum": None, "target_intervals": (1e6, 1e6), "max_episode_steps": 10**6}
    _, agent, env = restore(builtin("mcp", "humanoid", "location"), num_envs=1, seed=0, **changes)
    player = Show(agent.actor.policy, env)
    page = visit(player)
    place = env.episode["target"][0]

    def choose(x, y):
        before = place.clone()
        click(page, x, y)
        wait(lambda: (place != before).any(), page)
        steps = player.steps  # success is of the last place until a step measures it
        wait(lambda: player.steps > steps + 1, page)

    def away():
        return float(torch.linalg.vector_norm(env.com[0, :2] - place))

    def direction():
        x, y = (place - env.com[0, :2]).tolist()
        return math.atan2(y, x)

    def speed():
        return float(torch.linalg.vector_norm(env.simulation.state["qvel"][0, :2]))

    choose(WIDTH - 60, HEIGHT - 80)
    first = away()
    wait(lambda: away() < first - 0.3, page)
    choose(WIDTH - 60, HEIGHT / 2)  # while it walks; the panel covers the left half
    wait(lambda: env.episode["success"][0], page)
    page.wait_for_timeout(3000)
    assert away() < 0.5
    assert speed() < 0.3
    choose(WIDTH - 60, HEIGHT - 80)
    far = away()
    wait(lambda: away() < far - 0.3, page)
    move(page, WIDTH / 2, HEIGHT - 80)
    hold(page, "ArrowDown", lambda: 1.0 < away() < 1.25)  # at 0.75 m/s, the place leads by 1.125 m
    seen = direction()
    hold(page, "ArrowLeft", lambda: abs(math.remainder(direction() - seen, math.tau)) > 0.2)
    hold(page, " ", lambda: away() < 0.3)  # where it is
    wait(lambda: speed() < 0.1, page)
    assert not player.began


def test_the_biped_takes_a_box_that_was_clicked_to_the_ground_that_was_clicked(visit):
    distances = dict.fromkeys(["object_distances", "target_distances"], (1.5, 1.6))
    directions = dict.fromkeys(["object_directions", "target_directions"], (-0.1, 0.1))
    changes = {"curriculum": None, "max_episode_steps": 10**6} | distances | directions
    _, agent, env = restore(builtin("mcp", "biped", "carry"), num_envs=1, seed=1, **changes)
    model = env.simulation.model
    model.geom_rgba[model.body("box").geomadr[0]] = 1.0, 0.0, 1.0, 1.0
    player = Show(agent.actor.policy, env)
    page = visit(player)

    def stands():
        return player.state["success"][0]

    wait(stands, page)
    page.wait_for_timeout(2 * LONG)  # until the picture has this state
    red, green, blue = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float).transpose(2, 0, 1)
    rows, columns = ((red > 2 * green) & (blue > 2 * green)).nonzero()
    first = target(player).clone()
    click(page, columns.mean(), rows.mean())  # on the box
    page.wait_for_timeout(LONG)
    assert stands()
    assert (target(player) == first).all()
    click(page, WIDTH - 60, HEIGHT - 80)  # on the ground
    wait(lambda: (target(player) != first).any(), page)
    place = target(player).clone()
    wait(lambda: not stands(), page)
    wait(stands, page)
    box = env.simulation.outputs["xpos"][0, model.body("box").id, :2]
    assert torch.linalg.vector_norm(box - place) < 0.2
    assert torch.linalg.vector_norm(place - first) > 0.5
    assert player.pushed < 1.0
