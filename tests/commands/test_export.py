"""Exported policies act as the environment's policy does, in programs that know nothing of it."""

import sys

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.commands import export
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.export import DeterministicPolicy
from torchrl_mcp.runs.policies import restore


def call(*words):
    export.main([*map(str, words)])


@pytest.fixture(scope="module")
def played():
    """Observations, goals and deterministic actions of the biped's built-in policy in its environment."""
    _, agent, env = restore(builtin("mcp", "biped"), num_envs=3, seed=5)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        steps = env.rollout(4, agent.actor.policy).flatten()
    return steps["observation"], steps["goal"], steps["action"]


def test_onnxruntime_and_torch_export_play_the_actions_of_the_policy(played, tmp_path, capsys):
    onnxruntime = pytest.importorskip("onnxruntime", reason="needs pip install 'torchrl-mcp[onnx]'")
    pytest.importorskip("onnxscript", reason="needs pip install 'torchrl-mcp[onnx]'")
    call("builtin:biped", "--onnx", tmp_path / "biped.onnx", "--torch", tmp_path / "biped.pt2")
    assert "differs from torch by at most" in capsys.readouterr().out
    observation, goal, action = played
    session = onnxruntime.InferenceSession(str(tmp_path / "biped.onnx"))
    (found,) = session.run(None, {"observation": observation.numpy(), "goal": goal.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), action, atol=1e-5, rtol=0)
    (single,) = session.run(None, {"observation": observation[:1].numpy(), "goal": goal[:1].numpy()})
    torch.testing.assert_close(torch.from_numpy(single), action[:1], atol=1e-5, rtol=0)
    program = torch.export.load(tmp_path / "biped.pt2").module()
    torch.testing.assert_close(program(observation, goal), action, atol=1e-5, rtol=0)


def test_without_onnx_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(SystemExit, match=r"pip install 'torchrl-mcp\[onnx\]'"):
        call("builtin:biped", "--onnx", tmp_path / "biped.onnx")
    assert list(tmp_path.iterdir()) == []


def test_a_policy_that_remembers_is_refused_by_what_it_reads():
    class Remembering(torch.nn.Module):
        in_keys = ("observation", "goal", "option")

    with pytest.raises(ValueError, match="also reads option"):
        DeterministicPolicy(Remembering())


def test_something_to_write_is_asked_for(capsys):
    with pytest.raises(SystemExit):
        call("builtin:biped")
    assert "--onnx FILE, --torch FILE or --page DIR" in capsys.readouterr().err
