"""Web pages of policies: what is refused before anything is written, and what the browser's MuJoCo makes of scenes."""

import json

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Location
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.runs.policies import restore
from torchrl_mcp.viewer.page import folder as page_folder
from torchrl_mcp.viewer.page.clips import write_clips
from torchrl_mcp.viewer.page.description import require_playable
from torchrl_mcp.viewer.page.folder import write_page
from torchrl_mcp.viewer.page.networks import require_same_primitives, stages
from torchrl_mcp.viewer.page.runtimes import runtimes
from torchrl_mcp.viewer.page.scene import for_browser, require_same_model

SCENES = [
    (task, character)
    for task in (Heading, Dribble, Carry)
    for character in sorted(CHARACTERS)
    if task is not Carry or CHARACTERS[character].carrier
]


def player(name):
    _, agent, env = restore(locate(f"builtin:{name}"), num_envs=1, seed=0)
    return agent.actor.policy, env


@pytest.fixture(scope="module")
def walker():
    """Policy and environment of the biped that goes to places."""
    return player("biped-location")


def require_refusal(players, folder, word):
    """Require that a page is refused with a word, and that nothing is written."""
    with pytest.raises(ValueError, match=word):
        write_page(players, folder, title="a page", command="-")
    assert not folder.exists()


class Wander(Location):
    """A task of somebody's own."""


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Holdout(1, directions=(0.0, 1.0)), "Holdout"),
        (lambda: Wander("biped", 1), "Wander"),
    ],
)
def test_a_task_that_javascript_does_not_know_is_refused_by_name(make, word, walker, tmp_path):
    require_refusal({"gate": (walker[0], make())}, tmp_path / "page", word)


def test_a_shape_that_javascript_does_not_draw_is_refused_by_name():
    env = Location("biped", 1)
    env.simulation.model.geom_type[-1] = mujoco.mjtGeom.mjGEOM_MESH
    with pytest.raises(ValueError, match="mjGEOM_MESH"):
        require_playable(env)


@pytest.mark.parametrize(("character", "loops"), [("biped", False), ("trex", True)])
def test_clips_are_written_as_the_states_of_bodies_in_each_control_step(character, loops, tmp_path):
    env = player(character)[1]
    described = write_clips(env, tmp_path, "clip")
    assert [clip["name"] for clip in described] == [name.replace("_", " ") for name in env.library.names]
    rows = np.fromfile(tmp_path / described[1]["clip"]["file"], np.float32).reshape(
        302, len(env.library.body_names), 13
    )
    assert env.library.loops.all() == loops
    for step in (0, 7, 301):
        time = torch.tensor([step * env.control_timestep], dtype=torch.float64)
        bodies = env.library.at(torch.tensor([1]), time).bodies
        expected = torch.cat([field[0] for field in bodies], -1)
        np.testing.assert_allclose(rows[step], expected, atol=1e-5)
    first = env.library.at(torch.tensor([1]), torch.zeros(1, dtype=torch.float64))
    assert described[1]["clip"]["qpos"] == first.qpos[0].tolist()


def test_gates_over_other_primitives_are_refused(walker):
    other = stages(walker[0])
    changed = stages(player("biped-heading")[0])
    with torch.no_grad():
        next(changed["primitives"].parameters()).add_(1.0)
    require_same_primitives([other, stages(player("biped-heading")[0])])
    with pytest.raises(ValueError, match="gate 2"):
        require_same_primitives([other, changed])


def test_a_policy_without_gates_is_refused(walker):
    class Direct(torch.nn.Module):
        in_keys = ("observation", "goal")

    with pytest.raises(ValueError, match="method=mcp"):
        stages(Direct())


def test_without_npm_the_remedy_is_named_and_nothing_is_written(walker, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path))
    require_refusal({"gate": walker}, tmp_path / "page", "npm")


def test_without_a_connection_npms_reason_is_named_and_a_later_call_tries_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("npm", "node"):
        (tmp_path / name).write_text("#!/bin/sh\necho no route to the registry >&2\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    for _ in range(2):
        with pytest.raises(ValueError, match="no route to the registry"):
            runtimes()
    assert list((tmp_path / "cache" / "torchrl-mcp").iterdir()) == []


@pytest.mark.parametrize(("task", "character"), SCENES, ids=lambda value: getattr(value, "__name__", value))
def test_the_browsers_mujoco_compiles_every_scene_to_the_model_of_pythons(task, character, page_runtimes):
    env = task(character, 1)
    pinned = json.loads((page_runtimes / "package.json").read_text())["dependencies"]["@mujoco/mujoco"]
    assert require_same_model(for_browser(env.scene), env.simulation.model, page_runtimes) == pinned


def test_a_model_that_differs_is_refused_with_the_fields(page_runtimes):
    env = Location("biped", 1)
    heavier = for_browser(env.scene).replace('damping="', 'damping="9', 1)
    with pytest.raises(ValueError, match="dof_damping"):
        require_same_model(heavier, env.simulation.model, page_runtimes)


def test_a_broken_scene_is_refused_with_mujocos_reason_and_nothing_is_written(
    walker, page_runtimes, tmp_path, monkeypatch
):
    broken = '<mujoco><worldbody><body><joint type="wheel"/></body></worldbody></mujoco>'
    monkeypatch.setattr(page_folder, "for_browser", lambda scene: broken)
    require_refusal({"gate": walker}, tmp_path / "page", "wheel")
