"""What this machine or the command line lacks is said before a folder exists."""

import pytest
import torch
from refusals import refused

from torchrl_mcp.runs import experiment, requirements
from torchrl_mcp.runs.configuration import compose_run

HEADING = ["task=heading", "character=humanoid"]
SCRATCH = ["method=scratch", "evaluation.episodes=2"]
WITHOUT_CUDA = pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is available")


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        pytest.param(["device=cuda"], ["device=cuda", "device=cpu"], marks=WITHOUT_CUDA),
        (["device=mps"], ["device=mps"]),
        (["logger=wandb"], ["logger=wandb", "torchrl-mcp[wandb]"]),
        (["logger=mlflow"], ["logger=mlflow", "torchrl-mcp[mlflow]"]),
        ([*HEADING], ["pretrained=builtin"]),
        ([*HEADING, "stage=transfer"], ["pretrained=builtin"]),
        ([*HEADING, "stage=transfer", "method=moe"], ["pretrained=<folder>"]),
        (["task=heading", "stage=transfer", "character=ant"], ["character=ant", "character=biped"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.max_turns=0.1"], ["max_turns"]),  # in the evaluation alone
        ([*SCRATCH, "task=carry", "task.evaluation.object_distances=[0,0.1]"], ["object_distances"]),
        ([*SCRATCH, "task=carry", "task.evaluation.speed=[0.5,1.0]"], ["speed=[0.5, 1.0]"]),
        ([*SCRATCH, "task=heading", "+task.transfer.seed=3"], ["task.transfer.seed"]),  # a run gives these itself
        ([*SCRATCH, "task=heading", "+task.transfer.num_envs=3"], ["task.transfer.num_envs", "training.num_envs"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.seed=3"], ["task.evaluation.seed"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.num_envs=3"], ["task.evaluation.num_envs"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.num_threads=3"], ["task.evaluation.num_threads"]),
    ],
    ids=lambda value: value[-1],
)
def test_what_cannot_be_trained_or_evaluated_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, overrides, names
):
    monkeypatch.setattr(requirements, "find_spec", lambda name: None)
    cfg = compose_run("preset=smoke", "logger=none", f"run_dir={tmp_path / 'run'}", *overrides)
    message = refused(lambda: experiment.train(cfg), *names, untouched=tmp_path)
    assert ("pretrained=builtin" in message) == ("pretrained=builtin" in names)
