"""Every method trains in environments that are not the library's: both stages, evaluation, resuming, films."""

import itertools
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from points import LENGTH, Point
from refusals import refused
from smoke import configure, final_parts, rows

from torchrl_mcp.runs import experiment, policies, records
from torchrl_mcp.runs.trust import trusting
from torchrl_mcp.training.run_folder import EVALUATION, read_json
from torchrl_mcp.viewer.film import save_film

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
    assert "begins new episodes" in capsys.readouterr().out
    assert records.is_complete(folder)
    assert rows(folder)[:-1] == rows(whole)[:-1]
    assert rows(folder)[-1] != rows(whole)[-1]


def test_a_run_in_environments_that_can_be_saved_is_resumed_to_the_same_numbers(tmp_path, capsys):
    own = (*OWN, "+task.transfer.snapshots=true", "task.transfer.env._target_=points.Lasting")
    with trusting(["points"]):
        whole = experiment.train(configure(tmp_path / "whole", "method=scratch", "checkpoint_interval=1", *own))
        folder = killed(whole, tmp_path / "run")
        experiment.resume(folder)
        assert "begins new episodes" not in capsys.readouterr().out
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


def spoilt(monkeypatch, outcome, *, after):
    """Let Gymnasium's points fail or return something else after a number of steps of all of them."""
    step, steps = Point.step, itertools.count()
    monkeypatch.setattr(Point, "step", lambda point, action: outcome() if next(steps) > after else step(point, action))


def die():
    raise EOFError("the simulator has ended")


def lose_count():
    state = {key: np.array([np.nan]) for key in ("observation", "achieved_goal", "desired_goal")}
    return {**state, "number": 0}, 0.0, False, False, {"is_success": False}


@pytest.mark.parametrize(
    ("outcome", "error", "names"),
    [(die, ChildProcessError, ["EOFError"]), (lose_count, FloatingPointError, ["observation"])],
)
def test_a_run_whose_environment_fails_in_the_middle_is_resumed_from_its_last_checkpoint(
    outcome, error, names, tmp_path, monkeypatch
):
    settings = ("method=scratch", "checkpoint_interval=1", *POINT, "training.total_frames=384", "evaluation.episodes=0")
    with monkeypatch.context() as patch:
        spoilt(patch, outcome, after=300)  # in the third batch of 128
        refused(lambda: experiment.train(configure(tmp_path / "run", *settings)), "Point-v0", *names, error=error)
    assert [row["frames"] for row in rows(tmp_path / "run")] == ["128", "256"]
    experiment.resume(tmp_path / "run")
    assert [row["frames"] for row in rows(tmp_path / "run")] == ["128", "256", "384"]


def test_a_policy_in_an_environment_that_draws_itself_is_filmed(runs, tmp_path):
    folder = runs["transfer"]
    _, agent, env = policies.restore(folder, num_envs=1, seed=0)
    save_film(agent.actor.policy, env, tmp_path / "film.gif", seconds=1.0, width=60, height=40)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.size == (60, 40)
        assert film.n_frames == 5  # of 10 steps, every second
