"""Exploration over the weights of frozen primitives: it plays their composite and scores the gate's logits."""

import pytest
import torch
from refusals import refused
from torch import nn
from torch.distributions import Independent, Normal

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian
from torchrl_mcp.methods.mcp import weights_actor


@pytest.mark.parametrize("mixer", [MultiplicativeGaussian, AdditiveGaussian])
def test_exploration_over_weights_plays_the_composite_s_deterministic_action(mixer, composite, states):
    heads = {"gate_activation": nn.Sigmoid(), "distribution_class": mixer}
    actor = weights_actor(composite(**heads), **heads, logits_std=0.2, frozen=["primitives"])
    with torch.no_grad():
        played = actor.policy(states(50))
    gates = torch.sigmoid(played["gate_logits"])
    assert torch.equal(played["gates"], gates)
    loc, scale = played["primitives", "loc"], played["primitives", "scale"]
    assert torch.equal(played["action"], mixer(loc, scale, gates).deterministic_sample)


def test_exploration_over_weights_scores_the_gate_s_logits(make_actor, sample):
    actor, parts = make_actor("weights")
    assert (actor.sampled, actor.log_prob) == ("gate_logits", "gate_logits_log_prob")
    stored = sample(actor, 50)
    observation = parts["observation_normaliser"](stored["observation"])
    loc = parts["gating"](observation, parts["goal_normaliser"](stored["goal"]))
    score = Independent(Normal(loc, 0.2), 1).log_prob(stored["gate_logits"])
    torch.testing.assert_close(stored["gate_logits_log_prob"], score)
    deviation = ((stored["gate_logits"] - loc) / 0.2).square().mean().item()
    assert deviation == pytest.approx(1, abs=0.4)  # 200 squared normal deviates: four standard errors

    actor.trained.get_dist(stored).log_prob(stored["gate_logits"]).sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in parts["gating"].parameters())
    assert all(parameter.grad is None for parameter in parts["primitives"].parameters())


def test_the_noise_of_the_logits_can_be_learned(composite, states):
    heads = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    parts = composite(**heads, learned_logits_std=0.4)
    actor = weights_actor(parts, **heads, logits_std=0.2, frozen=["primitives"])
    with torch.no_grad():
        stored = actor.policy(states(50))
    torch.testing.assert_close(stored["gate_scale"], torch.full((50, 4), 0.4))
    # Where the logits are far from their mean, a wider Gaussian makes them likelier.
    stored["gate_logits"] = stored["gate_loc"] + 2.0
    actor.trained.get_dist(stored).log_prob(stored["gate_logits"]).sum().backward()
    (log_std,) = parts["gate_noise"].parameters()
    torch.testing.assert_close(log_std.grad, torch.full((4,), 50 * ((2.0 / 0.4) ** 2 - 1)))


@pytest.mark.parametrize(
    ("frozen", "std", "names"),
    [
        ((), 0.2, ("transfer.freeze", "exploration=action")),
        (("observation_normaliser",), 0.2, ("transfer.freeze", "exploration=action")),
        (("primitives",), 0.0, ("logits_std",)),
        (("primitives",), -0.2, ("logits_std",)),
        (("primitives",), float("nan"), ("logits_std",)),
    ],
)
def test_free_primitives_and_an_impossible_standard_deviation_are_refused(frozen, std, names, composite):
    heads = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    parts = composite(**heads)
    refused(lambda: weights_actor(parts, **heads, logits_std=std, frozen=frozen), *names)
