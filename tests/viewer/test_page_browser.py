"""Web pages of policies in a real browser: ``pip install playwright``, and Chromium by ``apt-get install chromium``."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
pytest.importorskip("onnxscript", reason="needs pip install 'torchrl-mcp[onnx]'")

from chance import require_share
from playwright import sync_api as playwright

from torchrl_mcp.envs import Carry, Heading, Imitation, Location
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.runs.policies import policy_config, restore
from torchrl_mcp.viewer.page.folder import write_page

CHROMIUM = next(filter(None, map(shutil.which, ["chromium", "chromium-browser", "google-chrome"])), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed: apt-get install chromium")

FLAGS = ["--no-sandbox", "--disable-quic", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

PATIENCE = 120_000
"""Milliseconds: without a GPU a browser draws a picture in a second."""

NETWORKS = ("humanoid-location", "humanoid-speeds", "trex-dribble", "biped-carry", "humanoid")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


FOLLOWING = {"switch_interval": math.inf, "terminate_on_fall": False, "max_error": 1e3, "max_episode_steps": 1000}
"""Settings of imitation with which an episode follows one clip to its end."""


def evaluated(name, num_envs):
    """The policy of a built-in network and environments of its evaluation."""
    path = locate(f"builtin:{name}")
    cfg = policy_config(path)
    settings = OmegaConf.to_container(cfg.evaluation.environment, resolve=True)
    if cfg.task.name == "imitation":
        settings |= FOLLOWING
    _, agent, env = restore(path, num_envs=num_envs, seed=7, **settings)
    return agent.actor.policy, env


@pytest.fixture(scope="module")
def written(tmp_path_factory, page_runtimes):
    """Folders of pages by the names of networks, written once."""
    folders = {}

    def write(*names, half=False):
        key = *names, half
        if key not in folders:
            folders[key] = tmp_path_factory.mktemp(names[0])
            write_page(
                {name: evaluated(name, 1) for name in names}, folders[key], title="a page", command="-", half=half
            )
        return folders[key]

    return write


@pytest.fixture
def simulated(browser, serve, written):
    """Run JavaScript with the simulation of a page as ``simulation``, without drawing."""
    tabs = []

    def run(code, argument, *names, half=False):
        address = serve(written(*names, half=half))
        tabs.append(tab := browser.new_page())
        tab.goto(f"{address}/page.json")
        tab.set_default_timeout(PATIENCE)
        program = (
            "async (argument) => { const { open } = await import('/simulation.js'); const simulation = await open();"
        )
        return tab.evaluate(f"{program} {code} }}", argument)

    yield run
    for tab in tabs:
        tab.close()


def remembered(env):
    """What a task remembers, as JavaScript calls it."""
    if isinstance(env, Heading):
        return {name: float(env.episode[name][0]) for name in ("direction", "speed")}
    if isinstance(env, Location):
        return {"target": env.episode["target"][0].tolist(), "leads": False}
    if isinstance(env, Imitation):
        frame = round(float(env.episode["time"][0]) / env.control_timestep)
        return {"frame": frame, "angle": float(env.episode["turn"][0]), "shift": env.episode["shift"][0].tolist()}
    if isinstance(env, Carry):
        return {"taken": bool(env.episode["taken"][0]), "held": bool(env.simulation.state["eq_active"][0].any())}
    return {}


def played(name, steps):
    """States of Python's environment under a policy, with what it observed and did in each."""
    policy, env = evaluated(name, 1)
    model, simulation = env.simulation.model, env.simulation
    marks = [body for body in range(model.nbody) if model.body_mocapid[body] >= 0]
    states, td = [], env.reset()
    if isinstance(env, Imitation):  # the first clip, which the page has in steps from its beginning
        first = env.beginning(torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.float64))
        td = env.reset(TensorDict(first, [1]), set_state=True)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(steps):
            td = policy(td)
            state = {key: simulation.state[key][0].tolist() for key in ("qpos", "qvel")}
            # A table that has just sunk is observed where it was.
            state["mocap_pos"] = simulation.outputs["xpos"][0, marks].flatten().tolist()
            state["mocap_quat"] = simulation.outputs["xquat"][0, marks].flatten().tolist()
            seen = {key: td[key][0].numpy().copy() for key in ("observation", "goal", "action")}
            states.append((state, remembered(env), seen))
            _, td = env.step_and_maybe_reset(td)
    return states


OBSERVED = """
  const { character_state } = await import("/observations.js");
  const { mujoco, description, scene: { model, data, task } } = simulation;
  const results = [];
  for (const [state, memory] of argument) {
    mujoco.mj_resetData(model, data);
    for (const [name, values] of Object.entries(state)) data[name].set(values);
    simulation.refresh();
    Object.assign(task, memory);
    const [observation, goal] = [character_state(model, data, description.num_bodies), task.goal()];
    const { action } = await simulation.act(observation, goal);
    results.push({ observation, goal, action });
  }
  return results;
"""


@pytest.mark.parametrize("name", NETWORKS)
def test_the_browser_observes_and_acts_as_python_does_in_each_of_its_states(name, simulated):
    states = played(name, 300)
    results = simulated(OBSERVED, [[state, memory] for state, memory, _ in states], name)
    for key, bound in (("observation", 1e-5), ("goal", 1e-5), ("action", 1e-5)):
        differences = [
            np.abs(np.array(result[key]) - seen[key]) for result, (_, _, seen) in zip(results, states, strict=True)
        ]
        assert np.max(differences) < bound, key


FOLLOWED = """
  const { mujoco, scenes } = simulation;
  const results = [];
  const state = () => {
    const { task, data } = simulation.scene;
    const [root] = task.frames[task.frame];
    return { frame: task.frame, place: task.place, heading: task.heading, root, angle: task.angle, shift: task.shift,
      qpos: Array.from(data.qpos) };
  };
  results.push(state());
  for (let step = 0; step < argument; step++) await simulation.advance();
  simulation.select(1);
  results.push(state());
  return results;
"""


def test_a_clip_begins_in_its_own_state_and_another_goes_on_where_the_character_is(simulated, written):
    begun, changed = simulated(FOLLOWED, 4 * 20, "humanoid")
    clip = json.loads((written("humanoid") / "page.json").read_text())["gates"][0]["clip"]
    assert begun["frame"] == 0
    assert begun["qpos"] == pytest.approx(clip["qpos"])
    assert (begun["angle"], *begun["shift"]) == pytest.approx((0, 0, 0), abs=1e-5)
    for state in (begun, changed):  # where the reference stands after it was moved
        (x, y, _, w, _, _, z), angle = state["root"][:7], state["angle"]
        moved = (x + 1j * y) * np.exp(1j * angle) + complex(*state["shift"])
        assert (moved.real, moved.imag) == pytest.approx(state["place"][:2], abs=1e-5)
        if state is begun:
            assert 2 * math.atan2(z, w) + angle == pytest.approx(state["heading"], abs=0.05)
    assert math.dist(begun["place"], changed["place"]) > 0.1


def test_half_precision_changes_no_action_of_a_built_in_network_by_more_than_a_thousandth(simulated):
    states = played("humanoid-location", 60)
    results = simulated(OBSERVED, [[state, memory] for state, memory, _ in states], "humanoid-location", half=True)
    differences = [
        np.abs(np.array(result["action"]) - seen["action"])
        for result, (_, _, seen) in zip(results, states, strict=True)
    ]
    assert np.max(differences) < 1e-3


WALKED = """
  const { apart } = await import("/observations.js");
  const { description } = simulation;
  const results = [];
  for (const place of argument) {
    simulation.reset();
    const { task } = simulation.scene;
    task.put(place);
    let [success, before] = [false, task.com];
    while (!success && simulation.time < 20 && !simulation.fallen) {
      for (let step = 0; step < description.substeps; step++) await simulation.advance();
      const speed = apart(task.com, before) / (description.physics_timestep * description.substeps);
      success = task.arrived() && speed < 0.1;
      before = task.com;
    }
    results.push(success);
  }
  return results;
"""


def test_the_humanoid_of_a_page_stands_at_as_many_places_as_published(simulated):
    generator = torch.Generator().manual_seed(0)
    distances = 10 * torch.rand(32, generator=generator)
    angles = 2 * math.pi * torch.rand(32, generator=generator)
    places = torch.stack([distances * angles.cos(), distances * angles.sin()], -1)
    reached = simulated(WALKED, places.tolist(), "humanoid-location", half=True)
    require_share(np.array(reached), 0.95)


@pytest.fixture
def visit(browser, serve, written):
    """Open the page of networks at a size, and wait until it runs."""
    tabs = []

    def open_page(*names, width=390, height=844, script=""):
        tabs.append(tab := browser.new_page(viewport={"width": width, "height": height}, has_touch=True))
        tab.set_default_timeout(PATIENCE)
        tab.add_init_script(script)
        address = serve(written(*names, half=True))
        tab.requested = []
        tab.on("request", lambda request: tab.requested.append(request.url.removeprefix(address)))
        tab.goto(address)
        return tab

    yield open_page
    for tab in tabs:
        tab.close()


def test_a_reader_steers_holds_gates_pushes_and_changes_the_gate_on_a_telephone(visit):
    tab = visit("humanoid-location", "humanoid-heading")
    tab.wait_for_selector("body.ready")
    tab.wait_for_function("page.simulation.time > 0.5")
    assert all(path.startswith(("/", "data:", "blob:")) for path in tab.requested)  # nothing from another place
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390

    before = tab.evaluate("page.task.target")
    tab.touchscreen.tap(40, 400)  # the ground in front
    tab.wait_for_function("before => page.task.target.join() !== before.join()", arg=before)
    tab.tap("#stop")
    assert tab.evaluate("page.task.speed") == 0.0
    direction = tab.evaluate("page.task.direction")
    tab.keyboard.press("ArrowLeft")
    assert tab.evaluate("page.task.direction") == pytest.approx(direction + math.radians(15))
    tab.keyboard.press("ArrowUp")
    assert tab.evaluate("page.task.speed") == pytest.approx(0.25)

    bar = tab.locator("#bars input").nth(2)
    box = bar.bounding_box()
    tab.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
    tab.mouse.down()
    tab.wait_for_function("Math.abs(page.simulation.weights[2] - 0.25) < 0.05")
    tab.mouse.up()
    bar.focus()
    tab.keyboard.press("End")
    tab.wait_for_function("page.simulation.weights[2] === 1")
    tab.tap("#release")
    assert tab.evaluate("page.simulation.pinned.size") == 0

    tab.tap("#pause")
    tab.tap("#push")
    tab.wait_for_function("document.getElementById('status').textContent.includes('paused')")
    place = tab.evaluate("page.task.com")
    tab.evaluate("async () => { for (let step = 0; step < 18; step++) await page.simulation.advance(); }")
    assert tab.evaluate("Math.hypot(...page.simulation.scene.data.xfrc_applied.subarray(6, 8))") > 10.0

    tab.click("#gates button >> nth=1")
    assert tab.evaluate("page.simulation.scene.gate.task") == "Heading"
    assert np.abs(np.subtract(tab.evaluate("page.task.com"), place)).max() < 1.0  # it goes on where it was
    tab.keyboard.press("Backspace")
    assert np.abs(tab.evaluate("page.task.com.slice(0, 2)")).max() < 0.2
    tab.click("#slow")
    assert tab.evaluate("page.pace") == 1


HIDE = "away => { window.away = away; document.dispatchEvent(new Event('visibilitychange')); }"

SLOWER = """() => {
  const act = page.simulation.act;
  page.simulation.act = function (...seen) {
    for (const end = performance.now() + 40; performance.now() < end; );
    return act.apply(this, seen);
  };
}"""


def test_a_page_says_that_it_does_not_keep_real_time(visit):
    tab = visit("humanoid-location")
    tab.wait_for_selector("body.ready")
    tab.evaluate(SLOWER)
    slow = "/0\\.\\d+ × real time: this device is too slow/"
    tab.wait_for_function(f"{slow}.test(document.getElementById('status').textContent)")


def test_a_page_in_a_hidden_tab_stands_still_and_goes_on_where_it_was(visit):
    tab = visit("humanoid-location")
    tab.wait_for_selector("body.ready")
    tab.wait_for_function("page.simulation.time > 0.1")
    tab.evaluate("Object.defineProperty(document, 'hidden', { get: () => window.away })")
    tab.evaluate(HIDE, True)
    tab.wait_for_timeout(1000)  # what was due when the tab was hidden
    before = tab.evaluate("page.simulation.time")
    tab.wait_for_timeout(2000)
    assert tab.evaluate("page.simulation.time") == before
    tab.evaluate(HIDE, False)
    tab.wait_for_function("time => page.simulation.time > time", arg=before)
    assert tab.evaluate("page.pictures.wanted") < 2.0  # the time away is not due


def test_a_browser_without_simd_gets_a_sentence_and_fetches_nothing_large(visit):
    tab = visit("humanoid-location", script="WebAssembly.validate = () => false;")
    tab.wait_for_function("document.getElementById('message').textContent.includes('WebAssembly SIMD')")
    assert not [path for path in tab.requested if "wasm" in path or "onnx" in path]
