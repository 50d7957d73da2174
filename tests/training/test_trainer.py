"""The loop as a whole: it learns, it stops in time, it continues to the same numbers."""

import csv
import gc
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from refusals import refused
from smoke import SMOKE, configure, final_parts, rows

from torchrl_mcp.envs import CharacterEnv, Heading
from torchrl_mcp.runs import build, experiment, policies
from torchrl_mcp.training import checkpoint, run_folder, update
from torchrl_mcp.training.collectors import LocalSource
from torchrl_mcp.training.threads import threads
from torchrl_mcp.training.trainer import Trainer
from torchrl_mcp.training.update import Update

ONE_BATCH = "training.total_frames=128"


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    return experiment.train(configure(tmp_path_factory.mktemp("runs") / "mcp", "training.total_frames=256"))


@pytest.mark.slow
def test_a_run_killed_with_sigkill_continues_to_the_same_numbers_bit_for_bit(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    settings = ["autocast=true", "checkpoint_interval=1", "training.total_frames=768"]
    experiment.train(configure(whole, *settings))

    arguments = [*SMOKE, f"run_dir={killed}", *settings]
    run = subprocess.Popen(
        [sys.executable, "-m", "torchrl_mcp.commands.train", *arguments], env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    deadline = time.monotonic() + 300
    while not (killed / "metrics.csv").exists() or len(rows(killed)) < 2:
        assert run.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.005)
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert len(rows(killed)) < 6

    experiment.resume(killed)
    assert rows(killed) == rows(whole)
    expected = final_parts(whole)
    for name, value in final_parts(killed).items():
        assert torch.equal(value, expected[name]), name


@pytest.mark.parametrize("failure", [FloatingPointError, KeyboardInterrupt])
def test_the_trajectory_source_is_stopped_when_a_run_fails(tmp_path, monkeypatch, failure):
    def fail(*arguments, **settings):
        raise failure

    stopped, stop = [], LocalSource.stop
    monkeypatch.setattr(LocalSource, "stop", lambda source: stopped.append(stop(source)))
    monkeypatch.setattr(Update, "__call__", fail)
    with pytest.raises(failure):
        experiment.train(configure(tmp_path / "run"))
    assert len(stopped) == 1


@pytest.mark.parametrize(
    "overrides",
    [
        ["method=scratch", "task=heading", "symmetry=augment", "learned_std=true", "width=0.1"],
        ["method=latent_space", "task=imitation", "symmetry=loss", "learned_std=true", "width=0.1", "autocast=true"],
    ],
    ids=" ".join,
)
def test_a_run_continues_in_or_after_its_warm_up_to_the_same_numbers_bit_for_bit(tmp_path, overrides):
    whole = tmp_path / "whole"
    settings = [*overrides, "training.warmup_batches=2", "checkpoint_interval=1", "keep_checkpoints=9"]
    experiment.train(configure(whole, *settings, "training.total_frames=384"))
    for frames in (128, 256):
        cut = tmp_path / str(frames)
        shutil.copytree(whole, cut)
        for path in sorted((cut / checkpoint.CHECKPOINTS).iterdir()):
            if run_folder.frames(path) > frames:
                path.unlink()
        experiment.resume(cut)
        assert rows(cut) == rows(whole)
        expected = final_parts(whole)
        for name, value in final_parts(cut).items():
            assert torch.equal(value, expected[name]), name


def test_the_same_seed_gives_the_same_run_and_another_seed_another(tmp_path, pretrained):
    experiment.train(configure(tmp_path / "same", "training.total_frames=256"))
    experiment.train(configure(tmp_path / "other", "seed=1", ONE_BATCH))
    assert rows(tmp_path / "same") == rows(pretrained)[:2]
    assert rows(tmp_path / "other")[0] != rows(pretrained)[0]


def test_a_transfer_of_a_transfer_keeps_the_width_of_the_primitives(tmp_path, pretrained):
    """Its own networks have another."""

    def run(name, origin, *settings):
        return experiment.train(configure(tmp_path / name, f"pretrained={origin}", ONE_BATCH, *settings))

    once = run("once", pretrained, "stage=transfer", "width=0.125")
    twice = run("twice", once, "stage=transfer", "width=0.03")
    for folder in (twice, run("again", twice)):
        assert layers(folder, "primitives") == layers(pretrained, "primitives")
        assert layers(folder, "gating") == layers(twice, "gating")
    assert layers(once, "gating") != layers(twice, "gating")


def layers(run, part):
    return {name: value.shape for name, value in final_parts(run).items() if name.startswith(f"{part}.")}


def test_unfrozen_transfer_starts_from_the_primitives_and_trains_them(tmp_path, pretrained):
    settings = ["stage=transfer", f"pretrained={pretrained}", "transfer.freeze=[]", "exploration=action"]
    start = build.make_agent(
        cfg := configure(tmp_path / "run", *settings),
        build.make_env(cfg, num_envs=1, seed=0),
        checkpoint.find(pretrained),
    )
    before = final_parts(pretrained)
    for name, value in start.parts["primitives"].state_dict().items():
        assert torch.equal(value, before[f"primitives.{name}"])
    experiment.train(cfg)
    after = final_parts(tmp_path / "run")
    assert not torch.equal(before["primitives.output.weight"], after["primitives.output.weight"])


@pytest.mark.parametrize("method", ["method=mcp", "mixer=additive", "method=scratch"])
def test_collection_and_loss_agree_before_the_first_update_in_bfloat16(tmp_path, method):
    # One gradient step per iteration: its report is from before the step. Matrix products of other batch sizes round
    # differently. test_methods has this test in float32.
    folder = tmp_path / "run"
    one_step = ["training.num_epochs=1", "training.minibatch_size=128", "training.total_frames=128"]
    experiment.train(configure(folder, method, "autocast=true", *one_step))
    (first,) = rows(folder)
    assert float(first["loss/clip_fraction"]) == 0.0
    assert abs(float(first["loss/max_ratio"]) - 1.0) <= 2e-3
    assert abs(float(first["loss/kl"])) <= 2e-3


def test_a_number_that_is_not_finite_stops_the_run_by_name_and_keeps_the_last_good_checkpoint(tmp_path):
    folder = tmp_path / "run"
    cfg = configure(folder, "checkpoint_interval=1", "optimizer.critic.lr=1e30", "objective.max_grad_norm=1e30")
    with pytest.raises(FloatingPointError, match=r"loss_critic|critic_grad_norm"):
        experiment.train(cfg)
    for value in final_parts(folder).values():
        assert value.isfinite().all()


@pytest.mark.parametrize("size", ["num_envs=7", "minibatch_size=100"])
def test_batches_that_do_not_divide_are_refused(tmp_path, size):
    cfg = configure(tmp_path / "run", f"training.{size}")
    refused(lambda: experiment.train(cfg), "frames_per_batch=128", size, untouched=tmp_path)


def test_a_reward_that_is_not_finite_is_the_tasks_mistake(tmp_path, monkeypatch):
    monkeypatch.setattr(Heading, "reward", lambda env: torch.full((env.num_envs,), torch.nan))
    cfg = configure(tmp_path / "run", "method=scratch", "task=heading", "character=biped", "stage=transfer")
    refused(lambda: experiment.train(cfg), "reward", "Heading", error=FloatingPointError)


def test_a_frozen_part_that_changes_stops_the_run(tmp_path, pretrained, monkeypatch):
    cfg = configure(tmp_path / "run", "stage=transfer", f"pretrained={pretrained}")
    real = Trainer._update_normalisers

    def meddle(trainer, batch):
        real(trainer, batch)
        trainer.agent.parts["primitives"].output.bias.data[0, 0] += 1e-6

    monkeypatch.setattr(Trainer, "_update_normalisers", meddle)
    with pytest.raises(RuntimeError, match="primitives"):
        experiment.train(cfg)


def test_collection_leaves_the_processors_to_physics_and_the_update_has_them_all(tmp_path, monkeypatch):
    numbers = {"step": set(), "update": set()}

    def watch(section, method):
        def watched(*args, **kwargs):
            numbers[section].add(torch.get_num_threads())
            return method(*args, **kwargs)

        return watched

    monkeypatch.setattr(CharacterEnv, "_step", watch("step", CharacterEnv._step))
    monkeypatch.setattr(Update, "__call__", watch("update", Update.__call__))
    gc.collect()  # finalisers of TorchRL's collectors, which other tests left, set the number of threads
    with threads(2):
        experiment.train(configure(tmp_path, ONE_BATCH))
    assert numbers == {"step": {1}, "update": {2}}


@pytest.mark.parametrize(("method", "autocast"), [("mcp", False), ("option_critic", True)])
def test_actor_and_critic_learn_the_same_at_the_same_time_as_in_turn_to_the_bit(
    tmp_path, monkeypatch, method, autocast
):
    settings = [f"method={method}", f"autocast={autocast}", "torch_threads=2", ONE_BATCH]
    with threads(2):
        experiment.train(configure(tmp_path / "together", *settings))
        with monkeypatch.context() as patch:
            patch.setattr(update, "side_by_side", in_turn)
            experiment.train(configure(tmp_path / "in_turn", *settings))
    assert rows(tmp_path / "together") == rows(tmp_path / "in_turn")
    expected = final_parts(tmp_path / "in_turn")
    for name, value in final_parts(tmp_path / "together").items():
        assert torch.equal(value, expected[name]), name


def in_turn(tasks):
    assert list(tasks) == ["actor", "critic"]
    with threads(1):
        return {name: task() for name, task in tasks.items()}


def test_the_shares_of_time_add_up_to_the_whole(pretrained):
    with (pretrained / "metrics.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            shares = {key: float(value) for key, value in row.items() if key.startswith("time/") and "steps" not in key}
            assert set(shares) == {"time/physics", "time/forward", "time/update", "time/other"}
            assert all(share > 0 for share in shares.values())
            assert sum(shares.values()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "overrides", [["method=mcp"], ["method=finetune", "task=imitation"], ["method=option_critic"]], ids=" ".join
)
def test_in_the_warm_up_normalisers_and_critic_learn_and_the_policy_waits(tmp_path, overrides):
    settings = [*overrides, "training.warmup_batches=1", "checkpoint_interval=1", "keep_checkpoints=9"]
    experiment.train(configure(tmp_path, *settings, "training.total_frames=256"))
    start, warm, first = (
        policies.restore(path, num_envs=1, seed=0)[1].parts.state_dict()
        for path in sorted((tmp_path / checkpoint.CHECKPOINTS).iterdir())
    )
    for name in start:
        learns_first = name.startswith(("critic", "observation_normaliser", "goal_normaliser"))
        assert torch.equal(start[name], warm[name]) != learns_first, name
    learning = [name for name in warm if "critic" not in name and "normaliser" not in name]
    assert any(not torch.equal(warm[name], first[name]) for name in learning)
    waiting, *learning = rows(tmp_path)
    assert float(waiting["loss/kl"]) == pytest.approx(0.0, abs=1e-6)
    assert float(waiting["loss/actor_grad_norm"]) == 0.0
    assert all(float(row["loss/actor_grad_norm"]) > 0 for row in learning)


def test_finetuning_begins_with_the_noise_of_the_task_and_not_with_that_of_imitation(tmp_path):
    imitation = ["method=finetune", "task=imitation", "character=biped", "learned_std=true", "action_std=0.02"]
    pretrained = experiment.train(configure(tmp_path / "run", *imitation, "training.total_frames=128"))
    task = ["method=finetune", "task=heading", "stage=transfer", "learned_std=true", "action_std=0.1"]
    cfg = configure(tmp_path / "task", *task, f"pretrained={pretrained}")
    agent = build.make_agent(cfg, build.make_env(cfg, num_envs=1, seed=0), checkpoint.find(pretrained))
    scale = agent.parts["policy"].scale.state_independent_scale.exp()
    torch.testing.assert_close(scale, torch.full_like(scale, 0.1))


def test_metrics_are_means_over_the_episodes_that_ended_and_over_all_steps(tmp_path):
    settings = ["method=scratch", "task=dribble", "character=biped", "curriculum=none"]
    cfg = configure(tmp_path, *settings, "task.transfer.max_episode_steps=5", "++task.transfer.terminate_on_fall=false")
    source = build.make_source(cfg)
    trainer = build.make_trainer(cfg, build.make_agent(cfg, source.env), source, tmp_path)
    batch = source.env.rollout(12, break_when_any_done=False)
    batch["next", "success"] = torch.arange(48).view(4, 12, 1) < 12
    rewards = batch["next", "reward"].squeeze(-1)
    returns = torch.cat([rewards[:, :5].sum(1), rewards[:, 5:10].sum(1)])
    metrics = trainer._episode_metrics(batch)
    assert (metrics["episode/count"], metrics["episode/length"], metrics["task/success"]) == (8, 5.0, 0.25)
    assert metrics["episode/return"] == pytest.approx(returns.mean().item(), rel=1e-5)
    assert metrics["episode/normalised_return"] == pytest.approx(returns.mean().item() / 5, rel=1e-5)
    assert metrics["reward"] == pytest.approx(rewards.mean().item(), rel=1e-5)


def test_returns_wait_until_episodes_can_have_their_full_length(tmp_path):
    settings = ["method=scratch", "task=heading", "width=0.05", "+task.transfer.max_episode_steps=50"]
    experiment.train(configure(tmp_path, *settings, "evaluation.episodes=0", "training.total_frames=384"))
    found = rows(tmp_path)  # of 32 steps in each environment
    assert [int(row["episode/count"]) > 0 for row in found] == [True, True, True]  # a biped falls within a second
    assert [row["episode/normalised_return"] == "nan" for row in found] == [True, False, False]
