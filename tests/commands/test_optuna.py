"""Hydra's Optuna sweeper optimises the final return: ``pip install 'torchrl-mcp[optuna]'``."""

import json
import sys

import pytest
import yaml

from torchrl_mcp.commands import train

pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs pip install 'torchrl-mcp[optuna]'")
TEN = [f"+note.x{i}=interval(0.0,1.0)" for i in range(10)]
SMOKE = ["preset=smoke", "logger=none", "num_threads=1", "progress_bar=false", "evaluation.episodes=2"]


def test_the_sweeper_is_given_the_return_of_each_run_and_finds_the_best(tmp_path, monkeypatch):
    words = ["--multirun", "hydra/sweeper=optuna", "hydra.sweeper.direction=maximize", "hydra.sweeper.n_trials=2"]
    words += ["hydra.sweeper.n_jobs=1", "hydra.sweeper.sampler.seed=0", "method=scratch"]
    words += [*SMOKE, "training.total_frames=128", "task.evaluation.max_episode_steps=20"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-train", *words, "optimizer.actor.lr=choice(1e-3,1e-4)"])
    train.main()
    (results,) = tmp_path.rglob("optimization_results.yaml")
    returns = [
        json.loads(path.read_text())["deterministic"]["normalised_return"] for path in tmp_path.rglob("evaluation.json")
    ]
    assert yaml.safe_load(results.read_text())["best_value"] == pytest.approx(max(returns))


def test_a_failed_run_is_a_failed_trial_and_ten_numbers_make_a_folder(tmp_path, command):
    words = ["--multirun", "hydra/sweeper=optuna", "hydra.sweeper.direction=maximize", "hydra.sweeper.n_trials=3"]
    words += ["hydra.sweeper.n_jobs=1", "hydra.sweeper.sampler.seed=1", "method=scratch", *SMOKE, *TEN]
    words += ["training.total_frames=128", "task.evaluation.max_episode_steps=20"]
    outcome = command("train", *words, "optimizer.actor.lr=choice(1e30,1e-4)", cwd=tmp_path)
    assert outcome.returncode
    failed = [line for line in outcome.stderr.splitlines() if line.startswith("failed: ") and ".log" in line]
    complete = list(tmp_path.rglob("evaluation.json"))
    assert failed
    assert len(failed) + len(complete) == 3
    (results,) = tmp_path.rglob("optimization_results.yaml")
    assert yaml.safe_load(results.read_text())["best_params"]["optimizer.actor.lr"] == 1e-4
