"""Every method on a real GPU, with physics on the CPU and on the GPU. Skipped where there is none."""

import csv

import pytest
import torch

from torchrl_mcp.runs import experiment, policies
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training import checkpoint

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
METHODS = ["mcp", "scratch", "finetune", "hierarchical", "option_critic", "moe", "latent_space"]
SETTINGS = ["preset=smoke", "logger=none", "progress_bar=false", "num_threads=1", "character=biped", "device=cuda"]


@pytest.mark.parametrize("physics", ["mujoco", "warp"])
@pytest.mark.parametrize("method", METHODS)
def test_a_method_learns_in_both_stages_resumes_and_is_evaluated(tmp_path, method, physics):
    if physics == "warp":
        pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")
    transfer = ["task=heading", "stage=transfer", "checkpoint_interval=1"]
    if method != "scratch":
        motions = "turning" if method == "hierarchical" else "single"
        pretraining = ["task=imitation", "stage=pretrain", f"motions={motions}"]
        transfer.append(f"pretrained={train(tmp_path / 'pretrain', method, physics, pretraining)}")
    run = train(tmp_path / "transfer", method, physics, transfer)
    first, expected = rows(run), parts(run)
    checkpoint.find(run).unlink()
    experiment.resume(run)
    assert len(rows(run)) == len(first) == 2
    for name, value in parts(run).items():
        torch.testing.assert_close(value, expected[name], atol=1e-2, rtol=1e-2, equal_nan=False, msg=name)
    evaluation = policies.evaluation(run, episodes=2, seed=0, max_episode_steps=3)
    assert evaluation["deterministic"]["return"] >= 0


def train(folder, method, physics, settings):
    """Train for two iterations."""
    cfg = compose_run(f"method={method}", f"physics={physics}", f"run_dir={folder}", *SETTINGS, *settings)
    cfg.training.total_frames = 2 * cfg.training.frames_per_batch * cfg.get("batch_factor", 1)
    return experiment.train(cfg)


def parts(folder):
    """Return the tensors of a run's last networks."""
    return policies.restore(checkpoint.find(folder), num_envs=1, seed=0)[1].parts.state_dict()


def rows(folder):
    """Return what a run recorded."""
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))
