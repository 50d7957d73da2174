"""Methods that hold on to an option, in the training loop: interrupted runs, frozen options, many options at once."""

import pytest
import smoke
import torch
from smoke import final_parts, rows

from torchrl_mcp.runs import build, experiment, policies
from torchrl_mcp.training.trainer import Trainer

BIPED = ["character=biped", "task=imitation"]
SMALL = {
    "option_critic": ["parts.options.trunk_cells=[16]", "parts.terminations.num_cells=[16]", "parts.values_cells=[16]"],
    "hierarchical": [
        "+primitives.network.policy.num_cells=[16]",
        "+gating.network.num_cells=[16]",
        "+critic.num_cells=[16]",
    ],
}


def configure(folder, method, *overrides):
    return smoke.configure(folder, "checkpoint_interval=1", f"method={method}", *SMALL[method], *overrides)


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """Folders of pre-trained options by method."""
    runs = tmp_path_factory.mktemp("runs")
    settings = {"option_critic": [], "hierarchical": [*BIPED, "training.num_envs=64"]}
    return {
        name: experiment.train(configure(runs / name, name, "training.total_frames=128", *setting))
        for name, setting in settings.items()
    }


class Interruption(Exception):
    """The run is cut off."""


def train_two_iterations(monkeypatch, cfg):
    """Train until the second iteration has been recorded and saved, and the run is interrupted."""
    advance = Trainer._advance

    def advance_and_stop(trainer, metrics, seconds):
        advance(trainer, metrics, seconds)
        if trainer.progress.iteration == 2:
            raise Interruption

    monkeypatch.setattr(Trainer, "_advance", advance_and_stop)
    with pytest.raises(Interruption):
        experiment.train(cfg)
    monkeypatch.undo()


@pytest.mark.parametrize("method", SMALL)
def test_an_interrupted_run_continues_with_the_option_that_was_held(tmp_path, monkeypatch, pretrained, method):
    settings = ["training.total_frames=384", "training.num_epochs=1"]
    if method == "hierarchical":
        # Batches of 32 steps and choices of 20: every batch but the first begins in the middle of one.
        settings += ["stage=transfer", "character=biped", "task=heading", f"pretrained={pretrained[method]}"]
        settings += ["batch_factor=1", "steps_per_choice=20"]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    experiment.train(configure(whole, method, *settings))
    train_two_iterations(monkeypatch, configure(broken, method, *settings))
    assert len(rows(broken)) == 2
    experiment.resume(broken)
    assert rows(broken) == rows(whole)
    assert len(rows(whole)) == 3
    expected = final_parts(whole)
    for name, value in final_parts(broken).items():
        assert torch.equal(value, expected[name]), name


def test_transfer_with_frozen_terminations_trains_options_and_values(tmp_path, pretrained):
    folder = tmp_path / "run"
    settings = ["stage=transfer", f"pretrained={pretrained['option_critic']}", "training.total_frames=256"]
    settings += ["transfer.freeze=[terminations,observation_normaliser]"]
    experiment.train(configure(folder, "option_critic", *settings))
    before, after = final_parts(pretrained["option_critic"]), final_parts(folder)
    changed = {name.partition(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"options", "critic", "goal_normaliser"}


def test_all_primitives_learn_in_one_run(pretrained):
    cfg, agent, _ = policies.restore(pretrained["hierarchical"], num_envs=1, seed=0)
    torch.manual_seed(cfg.seed)
    fresh = build.make_agent(cfg, build.make_env(cfg, num_envs=4, seed=0))
    for k in range(7):
        trained, untrained = (a.parts["primitives"].policies[k].state_dict() for a in (agent, fresh))
        assert not torch.equal(trained["output.weight"], untrained["output.weight"]), k


def test_environments_follow_one_clip_of_seven_each_to_the_end_of_an_episode():
    env = build.make_env(configure("nowhere", "hierarchical", *BIPED), num_envs=64, seed=0)
    rollout = env.rollout(40, break_when_any_done=False)
    assert set(rollout["option"].unique().tolist()) == set(range(7))
    begins = rollout["done"].new_zeros(64, 40)
    begins[:, 1:] = rollout["next", "done"].squeeze(-1)[:, :-1]
    changed = rollout["option"].diff(dim=1) != 0
    assert changed.any()
    assert not (changed & ~begins[:, 1:]).any()


def test_the_gate_learns_from_choices_and_environment_steps_are_counted(tmp_path, pretrained):
    folder = tmp_path / "run"
    settings = ["stage=transfer", "character=biped", "task=heading", f"pretrained={pretrained['hierarchical']}"]
    settings += ["training.num_epochs=1"]
    experiment.train(configure(folder, "hierarchical", *settings))
    (row,) = rows(folder)
    assert int(row["frames"]) == 8 * 128
    # All choices of the first update are judged before it: the ratio is one.
    assert abs(float(row["loss/kl"])) < 2e-3
    assert 0 < float(row["policy/entropy"]) <= torch.tensor(7.0).log().item() + 1e-5
    assert float(row["options/duration"]) <= 30


def test_collection_and_loss_of_options_agree_before_the_first_update_in_bfloat16(tmp_path):
    folder = tmp_path / "run"
    one_step = ["training.num_epochs=1", "training.minibatch_size=128", "training.total_frames=128"]
    experiment.train(configure(folder, "option_critic", "autocast=true", *one_step))
    (first,) = rows(folder)
    assert abs(float(first["loss/mean_ratio"]) - 1.0) <= 2e-3
    assert abs(float(first["loss/kl"])) <= 2e-3
