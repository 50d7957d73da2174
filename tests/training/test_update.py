"""A single update: what is minimised, how often, on which samples, and what is told of it."""

from types import SimpleNamespace

import pytest
import smoke
import torch
from refusals import refused
from tensordict import TensorDict
from torch import nn

from torchrl_mcp.objectives import ActorLoss
from torchrl_mcp.runs import build, experiment
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.trust import trusting
from torchrl_mcp.training.update import Objective, PPOSettings, Update


class Pull(ActorLoss):
    """A loss of known gradient, 3 + 4 on its only parameter, which remembers the samples that it sees."""

    out_keys = ("loss_one", "loss_other", "mean_ratio", "kl_approx", "entropy")

    def __init__(self):
        super().__init__()
        self.weight, self.seen, self.calls = nn.Parameter(torch.zeros(())), [], 0

    def forward(self, samples):
        self.seen += samples["advantage"].flatten().tolist()
        self.calls += 1
        terms = {"loss_one": 3 * self.weight, "loss_other": 4 * self.weight, "mean_ratio": 1 + 0.2 * self.calls}
        terms |= {"kl_approx": -0.1 * self.calls, "entropy": 100 * self.weight}
        return TensorDict({name: torch.as_tensor(value) for name, value in terms.items()})


def updated(folder, max_grad_norm):
    """Both losses after an update by plain gradient descent with step size 0.1, its divergences, and its metrics."""
    settings = ["preset=smoke", "method=scratch", "task=holdout", "logger=none", "num_threads=1", f"run_dir={folder}"]
    settings += ["training.frames_per_batch=32", "training.minibatch_size=8", "training.num_epochs=3"]
    cfg = compose_run(*settings, f"objective.max_grad_norm={max_grad_norm}")
    torch.manual_seed(0)
    source = build.make_source(cfg)
    agent = build.make_agent(cfg, source.env)
    trainer = build.make_trainer(cfg, agent, source, folder)
    losses = {"actor": Pull(), "critic": Pull()}
    optimizers = {name: torch.optim.SGD(loss.parameters(), lr=0.1) for name, loss in losses.items()}
    divergences = []
    objective = Objective(Numbered(), losses, optimizers, SimpleNamespace(step=divergences.append))
    with torch.no_grad():
        batch = source.env.rollout(8, agent.actor.policy, break_when_any_done=False)
    return losses, divergences, Update(agent, objective, trainer.settings)(batch, warming_up=False)


class PolicyGradient(ActorLoss):
    """The policy gradient of whatever the policy samples, without clipping."""

    out_keys = ("loss_objective", "mean_ratio", "kl_approx")

    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, samples):
        log_prob = self.policy.get_dist(samples).log_prob(samples[self.sampled])
        log_ratio = log_prob - samples[self.log_prob]
        terms = {"mean_ratio": log_ratio.exp().mean(), "kl_approx": -log_ratio.mean()}
        return TensorDict({"loss_objective": -(log_prob * samples["advantage"].squeeze(-1)).mean(), **terms})


class Numbered:
    """An estimator whose advantages tell the samples apart."""

    out_keys = ("advantage",)

    def __call__(self, batch):
        batch["advantage"] = torch.arange(32.0).view(4, 8, 1)
        return batch


@pytest.mark.parametrize(("num_envs", "minibatch_size"), [(7, 32), (4, 100)])
def test_settings_whose_batches_do_not_divide_are_refused(num_envs, minibatch_size):
    numbers = {"num_epochs": 1, "warmup_batches": 0, "checkpoint_interval": 1, "total_frames": 128}
    sizes = {"frames_per_batch": 128, "num_envs": num_envs, "minibatch_size": minibatch_size}
    words = [f"{name}={size}" for name, size in sizes.items()]
    refused(lambda: PPOSettings(**sizes, **numbers, max_grad_norm=None, autocast=False), *words)


@pytest.mark.parametrize(("limit", "slope"), [("null", 7.0), (1.0, 1.0)])
def test_an_update_minimises_every_term_of_a_loss_once_per_minibatch_and_epoch_with_clipped_gradients(
    tmp_path, limit, slope
):
    losses, _, metrics = updated(tmp_path, limit)
    for name, loss in losses.items():
        assert loss.weight.item() == pytest.approx(-0.1 * slope * 3 * 4, rel=1e-4)
        assert metrics[f"loss/{name}_grad_norm"] == pytest.approx(7.0)  # before clipping


def test_every_epoch_sees_every_sample_once_in_an_order_of_its_own(tmp_path):
    losses, _, _ = updated(tmp_path, 1.0)
    for loss in losses.values():
        epochs = [loss.seen[start : start + 32] for start in (0, 32, 64)]
        assert [sorted(epoch) for epoch in epochs] == [list(range(32))] * 3
        assert len({tuple(epoch) for epoch in [*epochs, range(32)]}) == 4


def test_the_step_size_follows_the_divergence_of_the_last_epoch(tmp_path):
    _, divergences, metrics = updated(tmp_path, 1.0)
    # E[r - 1 - log r]: 0.2 less 0.1 for each of the calls so far, of which 9 to 12 are the last epoch's.
    assert metrics["loss/kl"] == pytest.approx(0.1 * (9 + 10 + 11 + 12) / 4, rel=1e-4)
    assert divergences == [metrics["loss/kl"]]


@pytest.mark.parametrize("method", [["method=scratch"], ["method=mcp", "exploration=weights", "pretrained=builtin"]])
def test_a_loss_of_a_users_own_trains_a_run_by_its_name_alone(tmp_path, method):
    loss = f"{{_target_: {__name__}.PolicyGradient, _partial_: true}}"
    settings = ["task=heading", "character=biped", "stage=transfer", "~objective.loss", f"+objective.loss={loss}"]
    with trusting({__name__}):
        folder = experiment.train(smoke.configure(tmp_path / "run", *settings, *method))
    for row in smoke.rows(folder):
        assert float(row["loss/loss_objective"]) != 0
        assert float(row["loss/actor_grad_norm"]) > 0


def test_a_loss_that_does_not_declare_its_reports_is_refused_by_name_before_training():
    class Silent(nn.Module):
        out_keys = ("loss_objective", "kl_approx")

    losses = {"actor": Silent(), "critic": Pull()}
    optimizers = {"actor": None, "critic": None}
    with pytest.raises(ValueError, match=r"Silent.*mean_ratio"):
        Objective(Numbered(), losses, optimizers, None)
    Objective(Numbered(), losses, {"critic": None}, None)  # of a frozen actor
