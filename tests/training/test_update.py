"""A single update: what is minimised, how often, on which samples, and what is told of it."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_mcp.runs import build
from torchrl_mcp.runs.configuration import compose_run


class Pull(nn.Module):
    """A loss of known gradient, 3 + 4 on its only parameter, which remembers the samples that it sees."""

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
    """A trainer and both losses after an update by plain gradient descent with step size 0.1, and its metrics."""
    settings = ["preset=smoke", "method=scratch", "task=holdout", "logger=none", "num_threads=1", f"run_dir={folder}"]
    settings += ["training.frames_per_batch=32", "training.minibatch_size=8", "training.num_epochs=3"]
    cfg = compose_run(*settings, f"objective.max_grad_norm={max_grad_norm}")
    torch.manual_seed(0)
    source = build.make_source(cfg)
    agent = build.make_agent(cfg, source.env)
    trainer = build.make_trainer(cfg, agent, source, folder)
    trainer.losses = {"actor": Pull(), "critic": Pull()}
    trainer.optimizers = {name: torch.optim.SGD(loss.parameters(), lr=0.1) for name, loss in trainer.losses.items()}
    trainer.schedule = SimpleNamespace(told=[])
    trainer.schedule.step = trainer.schedule.told.append
    with torch.no_grad():
        batch = source.env.rollout(8, agent.actor.policy, break_when_any_done=False)
    samples = trainer.advantages(batch)
    samples["advantage"] = torch.arange(32.0).view(4, 8, 1)
    return trainer, trainer._update(samples, warming_up=False)


@pytest.mark.parametrize(("limit", "slope"), [("null", 7.0), (1.0, 1.0)])
def test_an_update_minimises_every_term_of_a_loss_once_per_minibatch_and_epoch_with_clipped_gradients(
    tmp_path, limit, slope
):
    trainer, metrics = updated(tmp_path, limit)
    for name, loss in trainer.losses.items():
        assert loss.weight.item() == pytest.approx(-0.1 * slope * 3 * 4, rel=1e-4)
        assert metrics[f"loss/{name}_grad_norm"] == pytest.approx(7.0)  # before clipping


def test_every_epoch_sees_every_sample_once_in_an_order_of_its_own(tmp_path):
    trainer, _ = updated(tmp_path, 1.0)
    for loss in trainer.losses.values():
        epochs = [loss.seen[start : start + 32] for start in (0, 32, 64)]
        assert [sorted(epoch) for epoch in epochs] == [list(range(32))] * 3
        assert len({tuple(epoch) for epoch in [*epochs, range(32)]}) == 4


def test_the_step_size_follows_the_divergence_of_the_last_epoch(tmp_path):
    trainer, metrics = updated(tmp_path, 1.0)
    # E[r - 1 - log r]: 0.2 less 0.1 for each of the calls so far, of which 9 to 12 are the last epoch's.
    assert metrics["loss/kl"] == pytest.approx(0.1 * (9 + 10 + 11 + 12) / 4, rel=1e-4)
    assert trainer.schedule.told == [metrics["loss/kl"]]
