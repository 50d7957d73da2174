"""Training on MuJoCo Warp, by one word."""

import csv

import pytest
import torch
from hydra import compose, initialize_config_module

from torchrl_mcp.envs import Heading, engines
from torchrl_mcp.runs import build, experiment, policies
from torchrl_mcp.training import checkpoint


def composed(*overrides):
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", ["method=scratch", "task=heading", "stage=transfer", "run_dir=never", *overrides])


def rows(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        lines = csv.DictReader(file)
        return [{k: v for k, v in row.items() if not k.startswith(("seconds", "time/"))} for row in lines]


def test_an_engine_that_is_not_installed_is_refused_with_the_remedy(monkeypatch):
    monkeypatch.setattr(engines, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'torchrl-mcp\[warp\]', or choose physics=mujoco"):
        build.require_equipment(composed("physics=warp"))
    with pytest.raises(ValueError, match="physics=warp needs MuJoCo Warp"):
        Heading("biped", 2, physics="warp")


def test_an_engine_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match="physics=bullet must be mujoco or warp"):
        build.require_valid(composed("physics=bullet"))
    with pytest.raises(ValueError, match="physics='bullet' is unknown: pass mujoco or warp"):
        Heading("biped", 2, physics="bullet")


def test_mujocos_threads_simulate_on_the_cpu_alone():
    with pytest.raises(ValueError, match="MuJoCo's threads simulate on the CPU"):
        Heading("biped", 2, device="meta")


def test_workers_do_not_simulate_on_a_device(monkeypatch):
    monkeypatch.setattr(engines, "find_spec", lambda name: object())
    with pytest.raises(ValueError, match=r"all environments at once.*pass collector=local"):
        build.require_equipment(composed("physics=warp", "collector=processes"))


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
