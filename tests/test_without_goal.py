"""Environments without a goal: every method that makes sense without one trains in both stages."""

import json
import warnings
from pathlib import Path

import goalless
import pytest
import smoke
from refusals import refused

from torchrl_mcp import conf
from torchrl_mcp.runs import build, experiment, export, policies
from torchrl_mcp.runs.trust import trusting
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.transfer import fingerprint

METHODS = sorted(file.stem for file in (Path(conf.__file__).parent / "method").glob("*.yaml"))
NEEDS_CLIPS = "hierarchical"

SMALL = (
    "task=holdout",
    "training.frames_per_batch=64",
    "training.minibatch_size=64",
    "training.num_epochs=1",
    "training.total_frames=64",
    "++batch_factor=1",
)


def configure(folder, *overrides, env="Runner"):
    return smoke.configure(folder, *SMALL, f"task.pretrain._target_=goalless.{env}", *overrides)


@pytest.mark.parametrize("env", [goalless.Runner, goalless.EmptyGoal])
def test_a_task_without_a_goal_emits_an_empty_one(env):
    emitted = env(3, seed=0).rollout(2)
    assert emitted["goal"].shape == emitted["next", "goal"].shape == (3, 2, 0)


@pytest.fixture(scope="module", params=[method for method in METHODS if method != NEEDS_CLIPS])
def trained(request, tmp_path_factory):
    """Run folders of pre-training, or None where there is none, and of transfer."""
    folder, method = tmp_path_factory.mktemp(request.param), f"method={request.param}"
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        if not configure(folder, method, "stage=transfer").transfer.keep:
            return None, experiment.train(configure(folder / "transfer", method, "stage=transfer"))
        pretrained = experiment.train(configure(folder / "pretrain", method, "stage=pretrain", env="EmptyGoal"))
        transfer = configure(folder / "transfer", method, "stage=transfer", f"pretrained={pretrained}")
        return pretrained, experiment.train(transfer)


def test_a_method_trains_what_it_does_not_freeze_and_keeps_the_rest(trained):
    pretrained, transferred = trained
    with trusting({"goalless"}):
        cfg, agent, env = policies.restore(transferred, num_envs=2, seed=0)
        start = build.make_agent(cfg, env, pretrained and checkpoint.find(pretrained)).parts
    frozen = {name for name, part in agent.parts.items() if fingerprint(part) == fingerprint(start[name])}
    empty = {name for name, part in agent.parts.items() if not any(v.numel() for v in part.parameters())}
    assert frozen - empty == set(cfg.transfer.freeze) - empty
    assert "observation_normaliser" in frozen or not cfg.transfer.freeze


def test_a_policy_is_evaluated_without_a_goal(trained):
    with trusting({"goalless"}):
        results = policies.evaluation(trained[1], episodes=3, seed=0, max_episode_steps=5)
    assert results["deterministic"]["length"] == 5


def test_a_policy_is_exported_without_a_goal(tmp_path):
    pytest.importorskip("onnxruntime", reason="needs pip install 'torchrl-mcp[onnx]'")
    run = experiment.train(configure(tmp_path / "run", "method=mcp", "stage=pretrain"))
    with trusting({"goalless"}):
        policy, states, described = export.example(run)
    assert json.loads(described["goal"]) == []
    assert export.write_onnx(policy, states, tmp_path / "policy.onnx", described) < 1e-5


def test_the_hierarchical_model_asks_for_the_motions_that_its_primitives_imitate(tmp_path):
    cfg = configure(tmp_path / "run", f"method={NEEDS_CLIPS}", "stage=pretrain")
    refused(lambda: experiment.train(cfg), "reference motions", "motions=turning", untouched=tmp_path)


def test_a_hierarchical_gate_chooses_without_a_goal(tmp_path):
    trainer = build.make_run(configure(tmp_path, f"method={NEEDS_CLIPS}", "stage=transfer"), tmp_path)
    before = fingerprint(trainer.agent.parts["gating"])
    trainer.run()
    assert fingerprint(trainer.agent.parts["gating"]) != before


def test_an_environment_of_gymnasium_needs_no_goal(tmp_path):
    settings = [setting for setting in SMALL if setting != "task=holdout"]
    run = experiment.train(
        smoke.configure(tmp_path / "run", *settings, "task=gymnasium", "task.pretrain.id=Pendulum-v1", "method=mcp")
    )
    results = policies.evaluation(run, episodes=2, seed=0)
    assert results["deterministic"]["length"] == 200
