"""Input injection: what the first policy of a new task is, to the bit."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict

from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.finetune import injected_actor, injected_parts
from torchrl_mcp.modules import InjectedPolicy
from torchrl_mcp.training.checkpoint import load_parts, run_checkpoint

S, OLD, NEW, A = 6, 20, 2, 3
POLICY = partial(InjectedPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)


def pretrained(*, blind):
    """Return parts that have seen data and whose weights have all moved that may."""
    torch.manual_seed(0)
    parts = injected_parts(Sizes(S, OLD, A), policy=POLICY, blind=blind)
    parts["observation_normaliser"].update(2 + 3 * torch.randn(50, S))
    parts["goal_normaliser"].update(1 + 5 * torch.randn(50, OLD))
    with torch.no_grad():
        for parameter in parts.parameters():
            if parameter.requires_grad:
                parameter.add_(0.1 * torch.randn_like(parameter))
    return parts


def transferred(parts, tmp_path, goal_dim, keep):
    """Return new parts for another goal, the kept ones by way of a checkpoint file."""
    file = run_checkpoint(parts).save(tmp_path / "checkpoint.torchrl")
    new = injected_parts(Sizes(S, goal_dim, A), policy=POLICY, blind=False)
    load_parts(new, keep, file)
    return new


def distribution(parts, observation, goal, *, autocast):
    td = TensorDict(observation=observation, goal=goal, batch_size=[len(observation)])
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        found = injected_actor(parts).trained.get_dist(td)
    return found.mean, found.stddev


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
def test_the_first_policy_of_a_new_task_is_the_pre_trained_one_to_the_bit_whatever_the_goals(tmp_path, autocast):
    old = pretrained(blind=True)
    new = transferred(old, tmp_path, NEW, ["policy", "observation_normaliser"])
    observation = 2 + 3 * torch.randn(64, S)
    before = distribution(old, observation, 9 * torch.randn(64, OLD), autocast=autocast)
    after = distribution(new, observation, 9 * torch.randn(64, NEW), autocast=autocast)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
def test_a_policy_that_saw_the_reference_goes_on_as_if_it_were_at_its_mean(tmp_path, autocast):
    old = pretrained(blind=False)
    new = transferred(old, tmp_path, NEW, ["policy", "observation_normaliser"])
    observation, mean = 2 + 3 * torch.randn(64, S), old["goal_normaliser"].mean.expand(64, OLD)
    before = distribution(old, observation, mean, autocast=autocast)
    after = distribution(new, observation, 9 * torch.randn(64, NEW), autocast=autocast)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    elsewhere, _ = distribution(old, observation, mean + 1, autocast=autocast)
    assert (elsewhere != before[0]).any(-1).all()


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
def test_where_the_goal_is_the_same_it_goes_on_to_the_bit_with_its_goal(tmp_path, autocast):
    old = pretrained(blind=False)
    new = transferred(old, tmp_path, OLD, list(old))
    observation, goal = 2 + 3 * torch.randn(64, S), 9 * torch.randn(64, OLD)
    before = distribution(old, observation, goal, autocast=autocast)
    after = distribution(new, observation, goal, autocast=autocast)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_at_transfer_everything_learns_and_the_goal_begins_to_count():
    parts = injected_parts(Sizes(S, NEW, A), policy=POLICY, blind=False)
    actor = injected_actor(parts)
    optimizer = torch.optim.SGD(actor.trained.parameters(), lr=0.1)
    td = TensorDict(observation=torch.randn(64, S), goal=torch.randn(64, NEW), batch_size=[64])
    (actor.trained.get_dist(td).mean - td["goal"].sum(-1, keepdim=True)).square().sum(-1).mean().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in actor.trained.parameters())
    optimizer.step()
    mean = actor.trained.get_dist(td).mean
    assert (mean != actor.trained.get_dist(td.clone().set("goal", -td["goal"])).mean).any(-1).all()


def test_a_blind_policy_cannot_learn_of_the_goal():
    parts = injected_parts(Sizes(S, NEW, A), policy=POLICY, blind=True)
    td = TensorDict(observation=torch.randn(64, S), goal=torch.randn(64, NEW), batch_size=[64])
    injected_actor(parts).trained.get_dist(td).mean.square().sum().backward()
    assert parts["goal_input"].weight.grad is None
    assert parts["policy"].input.weight.grad.abs().max() > 0
