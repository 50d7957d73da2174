"""What this machine or the command line lacks is said before a folder exists."""

from importlib.util import find_spec

import pytest
import torch

from torchrl_mcp.runs import experiment, requirements
from torchrl_mcp.runs.configuration import compose_run

HEADING = ["task=heading", "character=humanoid"]


def configure(folder, *overrides):
    return compose_run("preset=smoke", "logger=none", f"run_dir={folder / 'run'}", *overrides)


@pytest.mark.parametrize("kind", ["wandb", "mlflow"])
def test_a_logger_that_is_not_installed_is_named_with_what_installs_it(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(requirements, "find_spec", lambda name: None if name == kind else find_spec(name))
    with pytest.raises(ValueError, match=rf"logger={kind} needs {kind}: pip install 'torchrl-mcp\[{kind}\]'"):
        experiment.train(configure(tmp_path, f"logger={kind}"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is available")
def test_without_cuda_its_device_is_refused_as_such(tmp_path):
    with pytest.raises(ValueError, match=r"device=cuda: .* finds no CUDA device. Pass device=cpu"):
        experiment.train(configure(tmp_path, "device=cuda"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("overrides", [[], ["stage=transfer"]], ids=str)
def test_heading_without_pretraining_names_the_networks_that_come_with_the_library(tmp_path, overrides):
    with pytest.raises(ValueError, match="pretrained=builtin"):
        experiment.train(configure(tmp_path, *HEADING, *overrides))
    assert list(tmp_path.iterdir()) == []


def test_networks_that_do_not_come_with_the_library_are_not_offered(tmp_path):
    with pytest.raises(ValueError, match=r"pretrained=<folder>$"):
        experiment.train(configure(tmp_path, *HEADING, "stage=transfer", "method=moe"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["task=heading", "+task.evaluation.max_turns=0.1"], "the task has no argument max_turns"),
        (["task=carry", "task.evaluation.object_distances=[0,0.1]"], "object_distances"),
        (
            ["task=carry", "task.evaluation.speed=[0.5,1.0]"],
            r"speed=\[0.5, 1.0\] is out of range: pass a finite number",
        ),
    ],
    ids=str,
)
def test_what_the_evaluation_would_refuse_is_refused_before_training(tmp_path, settings, message):
    cfg = configure(tmp_path, "method=scratch", "evaluation.episodes=2", *settings)
    with pytest.raises(ValueError, match=message):
        experiment.train(cfg)
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("transfer.seed", "seed"),
        ("transfer.num_envs", "training.num_envs"),
        ("evaluation.seed", "evaluation.seed"),
        ("evaluation.num_envs", "evaluation.episodes"),
        ("evaluation.num_threads", "num_threads"),
    ],
)
def test_arguments_of_environments_that_the_run_gives_are_refused_in_the_task(tmp_path, name, setting):
    cfg = configure(tmp_path, "method=scratch", "task=heading", f"+task.{name}=3")
    with pytest.raises(ValueError, match=f"task.{name} would not be read: give {setting} instead"):
        experiment.train(cfg)
