"""Training on MuJoCo Warp, by one word."""

import math

import pytest
import torch
from refusals import refused
from smoke import rows

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.physics import engines
from torchrl_mcp.evaluation.rollout import evaluate
from torchrl_mcp.runs import configuration, experiment, policies, requirements
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training import checkpoint

EPISODES = 64
LIFT = 0.01
"""Metres by which characters begin above the ground.

At rest, the last bit decides whether a character touches it, and so do the first steps of all episodes: 1e-6 m make a
difference of 0.01 to the humanoid's return, with either engine.
"""
APART = 0.15
"""Largest relative difference of the returns after a pre-training: pairs of four seeds differed by 2 to 7 percent."""


def composed(*overrides):
    return compose_run("method=scratch", "task=heading", "stage=transfer", "run_dir=never", *overrides)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: experiment.train(composed("physics=warp", "autocast=false")), "physics=warp"),
        (lambda: Heading("biped", 2, physics="warp"), "physics=warp"),
        (lambda: Heading("biped", 2, physics="bullet"), "physics='bullet'"),
        (lambda: Heading("biped", 2, device="meta"), "device=meta"),
        (lambda: requirements.require_equipment(composed("physics=warp", "collector=processes")), "collector=local"),
    ],
    ids=["not installed", "not installed", "unknown", "no CPU", "workers on a device"],
)
def test_an_engine_that_cannot_simulate_is_refused(tmp_path, monkeypatch, call, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    refused(call, name, untouched=tmp_path)


@pytest.mark.parametrize(
    "character", ["biped", *(pytest.param(name, marks=pytest.mark.slow) for name in ("humanoid", "trex"))]
)
def test_a_run_trains_is_evaluated_by_mujoco_and_resumes_to_the_same_numbers(tmp_path, monkeypatch, character):
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    monkeypatch.chdir(tmp_path)
    settings = [
        *("physics=warp", f"character={character}", "preset=smoke", "logger=none", "progress_bar=false"),
        *("num_threads=1", "checkpoint_interval=1", "training.total_frames=256", "evaluation.episodes=2"),
        *("autocast=false", "width=0.1"),
    ]
    run = experiment.train(composed(*settings, f"run_dir={tmp_path / 'run'}"))
    recorded = rows(run)
    assert len(recorded) == 2
    checkpoint.find(run).unlink()
    experiment.resume(run)
    assert rows(run) == recorded
    _, _, env = policies.restore(run, num_envs=2, seed=0)
    assert env.simulation.state["qpos"].dtype == torch.float64


@pytest.mark.slow
@pytest.mark.parametrize("character", ["biped", "humanoid", "trex"])
def test_a_built_in_policy_earns_what_it_earns_on_mujocos_threads(character):
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    path, returns = builtin("mcp", character, "heading"), {}
    whole = policies.policy_config(path).evaluation.environment
    for physics in engines.ENGINES:
        _, agent, env = policies.restore(path, num_envs=EPISODES, seed=0, physics=physics, **whole)
        env.reset()
        start = env.get_state()
        start["qpos"][:, 2] += LIFT
        outcome = evaluate(agent.actor.policy, env, start=start)
        returns[physics] = env.normalised_return(outcome.returns).double()
    ours, exact = returns["warp"], returns["mujoco"]
    interval = 1.96 * math.sqrt((ours.var() + exact.var()) / EPISODES)
    assert exact.mean() > 0.9
    assert abs(ours.mean() - exact.mean()) < interval < 0.03  # a fall moves the mean by 0.01


@pytest.mark.slow
def test_a_pre_training_learns_as_on_mujocos_threads(tmp_path, monkeypatch):
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    monkeypatch.chdir(tmp_path)
    settings = [
        *("method=mcp", "task=imitation", "stage=pretrain", "character=biped", "width=0.25", "autocast=false"),
        *("training.num_envs=64", "training.frames_per_batch=1024", "training.minibatch_size=256"),
        *("training.num_epochs=4", "training.total_frames=51200", "checkpoint_interval=50", "evaluation.episodes=0"),
        *("logger=none", "progress_bar=false", "num_threads=1"),
    ]
    learned = {}
    for physics in engines.ENGINES:
        cfg = configuration.compose_run(*settings, f"physics={physics}", f"run_dir={tmp_path / physics}")
        run = experiment.train(cfg)
        found = [float(row["episode/normalised_return"]) for row in rows(run)]
        returns = [value for value in found if math.isfinite(value)]
        first, last = sum(returns[:3]) / 3, sum(returns[-10:]) / 10
        assert last > 1.3 * first
        learned[physics] = last
    assert learned["warp"] == pytest.approx(learned["mujoco"], rel=APART)
