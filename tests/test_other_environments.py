"""Every method trains in environments that are not the library's: both stages, evaluation, resuming, films."""

import shutil

import pytest
import torch
from points import LENGTH
from refusals import refused
from smoke import configure, final_parts, rows

from torchrl_mcp.runs import experiment, records
from torchrl_mcp.runs.trust import trusting
from torchrl_mcp.training.run_folder import EVALUATION, read_json

METHODS = ("scratch", "finetune", "hierarchical", "option_critic", "moe", "latent_space", "mcp")
SETTINGS = ("observation=[observation,achieved_goal]", "info=[is_success]", "worst=-30", "solved=0")
POINT = (
    *("task=gymnasium", "task.pretrain.id=points:Point-v0", "+task.pretrain.goal_number=number"),
    *(f"+task.{stage}.{setting}" for stage in ("pretrain", "transfer") for setting in SETTINGS),
    *("training.total_frames=256", "evaluation.episodes=3"),
)
OWN = (
    *("task=torchrl", "task.pretrain.env._target_=points.Lasting"),
    *(f"+task.{stage}.observation=[place]" for stage in ("pretrain", "transfer")),
    *(f"+task.{stage}.goal=[place]" for stage in ("pretrain", "transfer")),
    *(f"+task.{stage}.max_episode_steps=9" for stage in ("pretrain", "transfer")),
)


@pytest.fixture(scope="module", params=METHODS)
def runs(request, tmp_path_factory):
    """Folders of a method's runs, by stage."""
    root, method = tmp_path_factory.mktemp(request.param), f"method={request.param}"
    if request.param == "scratch":
        return {"transfer": experiment.train(configure(root / "transfer", method, *POINT))}
    first = experiment.train(configure(root / "pretrain", method, "stage=pretrain", *POINT))
    place = (f"pretrained={first}", "stage=transfer")
    return {"pretrain": first, "transfer": experiment.train(configure(root / "transfer", method, *place, *POINT))}


def test_every_method_pre_trains_transfers_and_is_evaluated(runs):
    for folder in runs.values():
        assert records.is_complete(folder)
        last = rows(folder)[-1]
        assert int(last["frames"]) >= 256
        assert float(last["episode/length"]) == LENGTH
        assert float(last["episode/normalised_return"]) == pytest.approx(1 + float(last["episode/return"]) / 30)
        assert 0 <= float(last["task/is_success"]) <= 1
        numbers = read_json(folder / EVALUATION)["deterministic"]
        assert numbers["length"] == LENGTH
        assert numbers["normalised_return"] == pytest.approx(1 + numbers["return"] / 30)
        assert 0 <= numbers["metrics"]["is_success"] <= 1
        assert numbers["terminated"] == 0


def killed(folder, copy):
    """A copy of a run without its last checkpoint, as if it had been killed before that."""
    shutil.copytree(folder, copy)
    saved = sorted((copy / "checkpoints").glob("*.torchrl"))
    assert len(saved) > 1
    saved[-1].unlink()
    return copy


@pytest.mark.parametrize("method", ["scratch", "option_critic"])  # without and with a memory of its own
def test_a_run_in_environments_that_are_not_saved_is_resumed_with_new_episodes(method, tmp_path, capsys):
    settings = ("stage=pretrain", "checkpoint_interval=1", "training.total_frames=384", "evaluation.episodes=0")
    whole = experiment.train(configure(tmp_path / "whole", f"method={method}", *POINT, *settings))
    folder = killed(whole, tmp_path / "run")
    experiment.resume(folder)
    assert "begin anew" in capsys.readouterr().out
    assert records.is_complete(folder)
    assert rows(folder)[:-1] == rows(whole)[:-1]
    assert rows(folder)[-1] != rows(whole)[-1]


def test_a_run_in_environments_that_can_be_saved_is_resumed_to_the_same_numbers(tmp_path, capsys):
    own = (*OWN, "+task.transfer.snapshots=true", "task.transfer.env._target_=points.Lasting")
    with trusting(["points"]):
        whole = experiment.train(configure(tmp_path / "whole", "method=scratch", "checkpoint_interval=1", *own))
        folder = killed(whole, tmp_path / "run")
        experiment.resume(folder)
        assert "begin anew" not in capsys.readouterr().out
        assert rows(folder) == rows(whole)
        first, second = final_parts(folder), final_parts(whole)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_nothing_is_written_for_an_environment_that_cannot_be_trained_in(tmp_path):
    settings = ("method=scratch", "task=gymnasium", "evaluation.episodes=3")
    folder = tmp_path / "run"
    for wrong, name in (("CartPole-v1", "discrete"), ("Nowhere-v0", "Nowhere"), (None, "task.pretrain.id")):
        chosen = () if wrong is None else (f"task.transfer.id={wrong}",)
        refused(lambda chosen=chosen: experiment.train(configure(folder, *settings, *chosen)), name)
    assert not (folder / "config.yaml").exists()
    assert not (folder / "checkpoints").exists()


def test_an_environment_that_does_other_than_its_specs_say_is_refused_before_the_training(tmp_path):
    own = (*OWN, "task.pretrain.env._target_=points.Widening", "+task.transfer.metrics=[far]")
    with trusting(["points"]):
        cfg = configure(tmp_path / "run", "method=scratch", "evaluation.episodes=3", *own)
        refused(lambda: experiment.train(cfg), "specs")
    assert not (tmp_path / "run" / "config.yaml").exists()
