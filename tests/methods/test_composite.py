"""The composite: its initial spread, primitives that cannot see the goal, its mixer, and frozen primitives."""

import pytest
import torch
from hydra.utils import instantiate
from refusals import refused
from tensordict import TensorDict
from torch import nn
from torch.distributions import Independent, Laplace
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian, TanhMultiplicativeGaussian
from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.mcp import composite_actor, composite_parts
from torchrl_mcp.modules import JointGating, Primitives
from torchrl_mcp.runs.configuration import compose_run

MIXERS = {"multiplicative": MultiplicativeGaussian, "additive": AdditiveGaussian}
ACTIVATIONS = {"sigmoid": nn.Sigmoid(), "softmax": nn.Softmax(dim=-1)}


@pytest.mark.parametrize("num_primitives", [1, 4, 8, 32])
@pytest.mark.parametrize("mixer", MIXERS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_composite_starts_at_the_standard_deviation_asked_for(num_primitives, mixer, activation, composite, states):
    heads = {"gate_activation": ACTIVATIONS[activation], "distribution_class": MIXERS[mixer]}
    for gain, tolerance in ((0.0, 1e-5), (0.01, 0.02)):
        parts = composite(**heads, num_primitives=num_primitives, gain=gain, initial_std=0.17)
        stddev = composite_actor(parts, **heads).trained.get_dist(states(50)).stddev
        torch.testing.assert_close(stddev, torch.full_like(stddev, 0.17), atol=0, rtol=tolerance)


@pytest.mark.parametrize("num_primitives", [0, -1])
def test_a_composite_of_nothing_is_refused(num_primitives, composite):
    heads = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    refused(lambda: composite(**heads, num_primitives=num_primitives), "num_primitives")


@pytest.mark.parametrize("method", ["mcp", "moe"])
def test_what_a_composite_plays_in_one_state_varies_by_the_standard_deviation_asked_for(method):
    cfg = compose_run(f"method={method}", "task=imitation")
    torch.manual_seed(1)
    parts = instantiate(cfg.parts)(Sizes(105, 208, 17))
    actor = instantiate(cfg.actor)(parts)
    states = TensorDict(observation=torch.randn(64, 105), goal=torch.randn(64, 208), batch_size=64)
    with torch.no_grad():
        actions = actor.trained.get_dist(states).sample((2000,))
    assert actions.var(0).mean().sqrt().item() == pytest.approx(cfg.action_std, rel=0.03)
    loc, _ = parts["primitives"](states["observation"])
    assert loc.std(-2).mean() > 0.3 * cfg.action_std  # they differ, so that the gate has a choice


@pytest.mark.parametrize("mixer", MIXERS)
def test_primitives_cannot_see_the_goal_and_the_composite_can(mixer, make_actor, states, sizes):
    actor, _ = make_actor(f"composite-{mixer}")
    td = states(10)
    td["goal"].requires_grad_()
    td["observation"].requires_grad_()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played = actor.policy(td)

    def sees(output, name):
        (gradient,) = torch.autograd.grad(output.sum(), td[name], retain_graph=True, allow_unused=True)
        return gradient is not None and bool(gradient.ne(0).any())

    loc, scale = played["primitives", "loc"], played["primitives", "scale"]
    for output in (*loc.unbind(1), *scale.unbind(1)):
        assert sees(output, "observation")
        assert not sees(output, "goal")
    assert sees(played["gates"], "observation")
    assert sees(played["gates"], "goal")
    log_prob = actor.trained.get_dist(td).log_prob(torch.zeros(10, sizes.action))
    assert sees(log_prob, "observation")
    assert sees(log_prob, "goal")


def test_the_composite_s_action_follows_the_goal(make_actor, states):
    actor, _ = make_actor("composite")
    td = states(10)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        here = actor.policy(td.clone())
        there = actor.policy(td.clone().set("goal", -td["goal"]))
    assert torch.equal(here["primitives", "loc"], there["primitives", "loc"])
    assert torch.equal(here["primitives", "scale"], there["primitives", "scale"])
    assert (here["action"] != there["action"]).any(-1).all()


@pytest.mark.parametrize("mixer", MIXERS)
def test_the_composite_is_the_mixer_of_normalised_inputs_through_its_parts(mixer, make_actor, sample):
    actor, parts = make_actor(f"composite-{mixer}")
    stored = sample(actor, 20)
    mean, variance = parts["observation_normaliser"].mean, parts["observation_normaliser"].variance
    observation = (stored["observation"] - mean) / variance.sqrt()
    mean, variance = parts["goal_normaliser"].mean, parts["goal_normaliser"].variance
    gates = torch.sigmoid(parts["gating"](observation, (stored["goal"] - mean) / variance.sqrt()))
    distribution = MIXERS[mixer](*parts["primitives"](observation), gates)
    torch.testing.assert_close(stored["gates"], gates, atol=1e-5, rtol=1e-5)
    log_prob = distribution.log_prob(stored["action"])
    torch.testing.assert_close(stored["action_log_prob"], log_prob, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("mixer", MIXERS)
def test_with_frozen_primitives_the_loss_evaluates_the_gate_alone(mixer, make_actor):
    actor, parts = make_actor(f"composite-{mixer}-frozen")
    trained = {parameter.data_ptr() for parameter in actor.trained.parameters()}
    assert trained == {parameter.data_ptr() for parameter in parts["gating"].parameters()}
    assert trained < {parameter.data_ptr() for parameter in actor.policy.parameters()}
    assert parts["primitives"] not in set(actor.trained.modules())
    assert {("primitives", "loc"), ("primitives", "scale")} < set(actor.stored)


@pytest.mark.parametrize("mixer", MIXERS)
def test_with_frozen_primitives_the_loss_reads_their_stored_outputs(mixer, make_actor, sample):
    actor, _ = make_actor(f"composite-{mixer}-frozen")
    stored = sample(actor, 20)
    stored["primitives", "loc"] = torch.randn_like(stored["primitives", "loc"])
    stored["primitives", "scale"] = torch.rand_like(stored["primitives", "scale"]) + 0.1
    expected = MIXERS[mixer](stored["primitives", "loc"], stored["primitives", "scale"], stored["gates"])
    distribution = actor.trained.get_dist(stored)
    torch.testing.assert_close(distribution.mean, expected.mean)
    torch.testing.assert_close(distribution.log_prob(stored["action"]), expected.log_prob(stored["action"]))


@pytest.mark.parametrize("mixer", MIXERS)
def test_the_gate_learns_from_frozen_primitives_as_from_others(mixer, make_actor, sample):
    gradients = {}
    for name in (f"composite-{mixer}", f"composite-{mixer}-frozen"):
        actor, parts = make_actor(name)
        stored = sample(actor, 20)
        actor.trained.get_dist(stored).log_prob(stored["action"]).sum().backward()
        gradients[name] = [parameter.grad for parameter in parts["gating"].parameters()]
        unfrozen = "frozen" not in name
        assert all((parameter.grad is not None) == unfrozen for parameter in parts["primitives"].parameters())
    for free, frozen in zip(*gradients.values(), strict=True):
        assert free.abs().max() > 0
        torch.testing.assert_close(free, frozen)


def negative(logits):
    """Weights that are positive at logits of 0, and negative for some."""
    return logits + 1e-3


def infinite(logits):
    """Weights that are infinite for logits below 0."""
    return (logits < 0).float() / (logits >= 0).float() + 1


@pytest.mark.parametrize("activation", [nn.ReLU(), negative, infinite], ids=["all zero", "negative", "infinite"])
def test_weights_that_compose_nothing_are_refused_before_training(composite, activation):
    heads = {"gate_activation": activation, "distribution_class": MultiplicativeGaussian}
    refused(lambda: composite(**heads), "gating.activation")


HEADS = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}


def composed_of_policies(sizes, actions, **heads):
    """Parts of a composite of two policies that exist."""
    networks = [nn.Sequential(nn.Linear(sizes.observation, 2 * actions), NormalParamExtractor()) for _ in range(2)]
    return composite_parts(
        sizes,
        gating=JointGating,
        primitives=lambda *sizes, initial_std: Primitives.from_policies(networks),
        num_primitives=2,
        initial_std=0.01,
        **HEADS | heads,
    ), networks


def test_policies_that_exist_are_composed_as_they_are(sizes, states):
    parts, networks = composed_of_policies(sizes, sizes.action)
    observation = states(20)["observation"]
    loc, scale = parts["primitives"](observation)
    for index, network in enumerate(networks):
        torch.testing.assert_close((loc[:, index], scale[:, index]), network(observation))


def test_policies_with_another_number_of_actions_are_refused(sizes):
    refused(lambda: composed_of_policies(sizes, sizes.action + 1), str(sizes.action + 1), str(sizes.action))


class WithoutAction(Independent):
    """A mixer that has no action without exploration."""

    def __init__(self, loc, scale, gates):
        super().__init__(Laplace(loc.mean(-2), scale.mean(-2)), 1)


class WithoutDeviation(WithoutAction):
    """A mixer whose variance is unknown."""

    deterministic_sample = property(lambda self: self.mean)

    @property
    def variance(self):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("mixer", "property_name"), [(WithoutAction, "deterministic_sample"), (WithoutDeviation, "stddev")]
)
def test_a_mixer_that_lacks_a_property_is_refused_before_training(mixer, property_name, composite):
    refused(lambda: composite(**HEADS | {"distribution_class": mixer}), mixer.__name__, property_name)


def test_a_mixer_whose_noise_is_not_proportional_to_that_of_its_primitives_is_refused(composite):
    mixer = TanhMultiplicativeGaussian
    refused(lambda: composite(**HEADS | {"distribution_class": mixer}), mixer.__name__, "proportional")
