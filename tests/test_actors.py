from dataclasses import replace
from functools import partial

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from tensordict import TensorDict
from torch import nn
from torch.distributions import Independent, Normal
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.actors import (
    composite_actor,
    composite_parts,
    gaussian_actor,
    gaussian_parts,
    weights_actor,
)
from torchrl_mcp.critics import value_critic
from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian
from torchrl_mcp.injection import injected_actor, injected_parts
from torchrl_mcp.latent import latent_actor, latent_parts
from torchrl_mcp.modules import Gating, GaussianPolicy, GoalEncoder, InjectedPolicy, Primitives
from torchrl_mcp.objectives import BoundedClipPPOLoss

S, G, A, K = 6, 2, 3, 4
GATING = partial(Gating, state_cells=(16, 8), goal_cells=(16, 8), joint_cells=(8,))
PRIMITIVES = partial(Primitives, trunk_cells=(16, 8), branch_cells=8)
MIXERS = {"multiplicative": MultiplicativeGaussian, "additive": AdditiveGaussian}
ACTIVATIONS = {"sigmoid": nn.Sigmoid(), "softmax": nn.Softmax(dim=-1)}
COMPOSITES = ["composite", "composite-frozen", "composite-additive", "composite-additive-frozen", "weights"]
ACTORS = [*COMPOSITES, "gaussian", "injected", "latent"]


def composite(mixer="multiplicative", activation="sigmoid", num_primitives=K, gain=1.0, **kwargs):
    return composite_parts(
        S,
        G,
        A,
        gating=partial(GATING, output_gain=gain),
        gate_activation=ACTIVATIONS[activation],
        primitives=partial(PRIMITIVES, output_gain=gain),
        num_primitives=num_primitives,
        distribution_class=MIXERS[mixer],
        **{"initial_std": 0.3, **kwargs},
    )


def configure(*overrides):
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", list(overrides))


def make(name):
    """Return the actor ``name`` and its parts, with a critic and normalisers that have seen data."""
    torch.manual_seed(0)
    mixer = "additive" if "additive" in name else "multiplicative"
    heads = {"gate_activation": ACTIVATIONS["sigmoid"], "distribution_class": MIXERS[mixer]}
    frozen = ["primitives", "observation_normaliser"] if "frozen" in name or name == "weights" else []
    if name == "gaussian":
        parts = gaussian_parts(S, G, A, policy=partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0))
        actor = gaussian_actor(parts)
    elif name == "injected":
        policy = partial(InjectedPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)
        parts = injected_parts(S, G, A, policy=policy, blind=False)
        actor = injected_actor(parts)
    elif name == "latent":
        decoder = partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)
        parts = latent_parts(S, G, A, encoder=partial(GoalEncoder, num_cells=(8,)), decoder=decoder, latent_dim=2)
        actor = latent_actor(parts)
    elif name == "weights":
        parts = composite(mixer)
        actor = weights_actor(parts, **heads, logits_std=0.2, frozen=frozen)
    else:
        parts = composite(mixer)
        actor = composite_actor(parts, **heads, frozen=frozen)
    for part in frozen:
        parts[part].requires_grad_(False)
    parts["observation_normaliser"].update(2 + 3 * torch.randn(50, S))
    parts["goal_normaliser"].update(torch.randn(50, G))
    return actor, parts


def states(*batch, seed=1):
    generator = torch.Generator().manual_seed(seed)
    observation = 2 + 3 * torch.randn(*batch, S, generator=generator)
    return TensorDict(observation=observation, goal=torch.randn(*batch, G, generator=generator), batch_size=batch)


def sample(actor, *batch):
    """What collection stores: the inputs, the random variable, its log-probability, and what the actor asks for."""
    with torch.no_grad():
        played = actor.policy(states(*batch))
    return played.select("observation", "goal", "action", actor.sampled, actor.log_prob, *actor.stored)


@pytest.mark.parametrize("num_primitives", [1, 4, 8, 32])
@pytest.mark.parametrize("mixer", MIXERS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_composite_starts_at_the_standard_deviation_asked_for(num_primitives, mixer, activation):
    heads = {"gate_activation": ACTIVATIONS[activation], "distribution_class": MIXERS[mixer]}
    for gain, tolerance in ((0.0, 1e-5), (0.01, 0.02)):
        parts = composite(mixer, activation, num_primitives, gain=gain, initial_std=0.17)
        stddev = composite_actor(parts, **heads).trained.get_dist(states(50)).stddev
        torch.testing.assert_close(stddev, torch.full_like(stddev, 0.17), atol=0, rtol=tolerance)


@pytest.mark.parametrize("num_primitives", [1, 4, 8, 32])
@pytest.mark.parametrize("mixer", MIXERS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_as_configured_the_composite_starts_near_the_standard_deviation_asked_for(num_primitives, mixer, activation):
    cfg = configure(f"mixer={mixer}", f"gating={activation}", f"num_primitives={num_primitives}")
    torch.manual_seed(0)
    parts, td = instantiate(cfg.parts)(S, G, A), states(200)
    parts["observation_normaliser"].update(td["observation"])
    stddev = instantiate(cfg.actor)(parts).trained.get_dist(td).stddev
    # Random last layers spread the deviations of states and actions around it.
    assert stddev.mean().item() == pytest.approx(cfg.primitives.initial_std, rel=0.1)


@pytest.mark.parametrize(
    ("method", "stage", "parameters"),
    [
        # tests/modules has the arithmetic; the goal is that of imitation, 208, or of heading, 2.
        # State and goal enter the critic's 1024 units: (105+208)*1024+1024 + 1024*512+512 + 512*1+1 = 846849.
        # mcp: the goal encoder's 208*512+512 = 107008 in place of 2*512+512 = 1536
        ("mcp", "pretrain", {"gating": 557_320, "primitives": 781_840, "critic": 846_849}),
        ("mcp", "transfer", {"gating": 451_848, "primitives": 781_840, "critic": 635_905}),
        ("scratch", "transfer", {"policy": 644_113, "critic": 635_905}),
        ("finetune", "pretrain", {"policy": 642_065, "goal_input": 212_992, "critic": 846_849}),
        ("finetune", "transfer", {"policy": 642_065, "goal_input": 2_048, "critic": 635_905}),
        ("moe", "pretrain", {"gating": 850_440, "primitives": 772_880, "critic": 846_849}),
        ("moe", "transfer", {"gating": 639_496, "primitives": 772_880, "critic": 635_905}),
        # Decoder: (105+8)*1024+1024 + 1024*512+512 + 512*17+17 = 116736 + 524800 + 8721
        ("latent_space", "pretrain", {"encoder": 88_464, "decoder": 650_257, "critic": 846_849}),
        ("latent_space", "transfer", {"encoder": 643_600, "decoder": 650_257, "critic": 635_905}),
    ],
)
def test_the_configuration_builds_appendix_e_for_the_biped(method, stage, parameters):
    task, goal_dim = {"pretrain": ("imitation", 208), "transfer": ("heading", 2)}[stage]
    cfg = configure(f"method={method}", f"stage={stage}", f"task={task}", "character=biped")
    parts = instantiate(cfg.parts)(105, goal_dim, 17)
    instantiate(cfg.critic)(parts, 105, goal_dim)
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
    assert counts == {"observation_normaliser": 0, "goal_normaliser": 0, **parameters}


@pytest.mark.parametrize("mixer", MIXERS)
def test_primitives_cannot_see_the_goal_and_the_composite_can(mixer):
    actor, _ = make(f"composite-{mixer}")
    td = states(10)
    td["goal"].requires_grad_()
    td["observation"].requires_grad_()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        played = actor.policy(td)

    def sees(output, name):
        (gradient,) = torch.autograd.grad(output.sum(), td[name], retain_graph=True, allow_unused=True)
        return gradient is not None and bool(gradient.ne(0).any())

    for k in range(K):
        for key in ("loc", "scale"):
            assert sees(played["primitives", key][:, k], "observation")
            assert not sees(played["primitives", key][:, k], "goal")
    assert sees(played["gates"], "observation")
    assert sees(played["gates"], "goal")
    log_prob = actor.trained.get_dist(td).log_prob(torch.zeros(10, A))
    assert sees(log_prob, "observation")
    assert sees(log_prob, "goal")


def test_the_composite_s_action_follows_the_goal():
    actor, _ = make("composite")
    td = states(10)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        here = actor.policy(td.clone())
        there = actor.policy(td.clone().set("goal", -td["goal"]))
    assert torch.equal(here["primitives", "loc"], there["primitives", "loc"])
    assert torch.equal(here["primitives", "scale"], there["primitives", "scale"])
    assert (here["action"] != there["action"]).any(-1).all()


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("name", ACTORS)
def test_before_an_update_the_loss_sees_the_log_probability_of_collection_to_the_bit(name, autocast):
    actor, _ = make(name)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        stored = sample(actor, 64)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        log_prob = actor.trained.get_dist(stored).log_prob(stored[actor.sampled])
    assert {x.dtype for x in (log_prob, stored[actor.sampled], stored[actor.log_prob])} == {torch.float32}
    assert log_prob.requires_grad
    assert (log_prob - stored[actor.log_prob]).abs().max() == 0


@pytest.mark.parametrize("mixer", MIXERS)
def test_the_composite_is_the_mixer_of_normalised_inputs_through_its_parts(mixer):
    actor, parts = make(f"composite-{mixer}")
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
def test_with_frozen_primitives_the_loss_evaluates_the_gate_alone(mixer):
    actor, parts = make(f"composite-{mixer}-frozen")
    trained = {parameter.data_ptr() for parameter in actor.trained.parameters()}
    assert trained == {parameter.data_ptr() for parameter in parts["gating"].parameters()}
    assert trained < {parameter.data_ptr() for parameter in actor.policy.parameters()}
    assert parts["primitives"] not in set(actor.trained.modules())
    assert {("primitives", "loc"), ("primitives", "scale")} < set(actor.stored)


@pytest.mark.parametrize("mixer", MIXERS)
def test_with_frozen_primitives_the_loss_reads_their_stored_outputs(mixer):
    actor, _ = make(f"composite-{mixer}-frozen")
    stored = sample(actor, 20)
    stored["primitives", "loc"] = torch.randn(20, K, A)
    stored["primitives", "scale"] = torch.rand(20, K, A) + 0.1
    expected = MIXERS[mixer](stored["primitives", "loc"], stored["primitives", "scale"], stored["gates"])
    distribution = actor.trained.get_dist(stored)
    torch.testing.assert_close(distribution.mean, expected.mean)
    torch.testing.assert_close(distribution.log_prob(stored["action"]), expected.log_prob(stored["action"]))


@pytest.mark.parametrize("mixer", MIXERS)
def test_the_gate_learns_from_frozen_primitives_as_from_others(mixer):
    gradients = {}
    for name in (f"composite-{mixer}", f"composite-{mixer}-frozen"):
        actor, parts = make(name)
        stored = sample(actor, 20)
        actor.trained.get_dist(stored).log_prob(stored["action"]).sum().backward()
        gradients[name] = [parameter.grad for parameter in parts["gating"].parameters()]
        unfrozen = "frozen" not in name
        assert all((parameter.grad is not None) == unfrozen for parameter in parts["primitives"].parameters())
    for free, frozen in zip(*gradients.values(), strict=True):
        assert free.abs().max() > 0
        torch.testing.assert_close(free, frozen)


@pytest.mark.parametrize("mixer", MIXERS)
def test_exploration_over_weights_plays_the_composite_s_deterministic_action(mixer):
    parts = composite(mixer)
    actor = weights_actor(
        parts,
        gate_activation=nn.Sigmoid(),
        distribution_class=MIXERS[mixer],
        logits_std=0.2,
        frozen=["primitives"],
    )
    with torch.no_grad():
        played = actor.policy(states(50))
    gates = torch.sigmoid(played["gate_logits"])
    assert torch.equal(played["gates"], gates)
    loc, scale = played["primitives", "loc"], played["primitives", "scale"]
    assert torch.equal(played["action"], MIXERS[mixer](loc, scale, gates).deterministic_sample)


def test_exploration_over_weights_scores_the_gate_s_logits():
    actor, parts = make("weights")
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


@pytest.mark.parametrize("frozen", [(), ("observation_normaliser",)])
def test_exploration_over_weights_refuses_primitives_that_are_not_frozen(frozen):
    heads = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    with pytest.raises(ValueError, match=r"primitives.*transfer\.freeze.*exploration=action"):
        weights_actor(composite(), **heads, logits_std=0.2, frozen=frozen)


@pytest.mark.parametrize("std", [0.0, -0.2, float("nan")])
def test_exploration_over_weights_refuses_an_impossible_standard_deviation(std):
    heads = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    with pytest.raises(ValueError, match="logits_std"):
        weights_actor(composite(), **heads, logits_std=std, frozen=["primitives"])


@pytest.mark.parametrize("name", ACTORS)
def test_without_exploration_the_action_is_deterministic_and_with_it_random(name):
    actor, _ = make(name)
    actions = {}
    for exploration in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with set_exploration_type(exploration), torch.no_grad():
            actions[exploration] = [actor.policy(states(10))["action"] for _ in range(2)]
    first, second = actions[ExplorationType.DETERMINISTIC]
    assert torch.equal(first, second)
    first, second = actions[ExplorationType.RANDOM]
    assert (first != second).any(-1).all()


def test_without_exploration_the_most_likely_action_of_each_mixer_is_played():
    td = states(10)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        product = make("composite")[0].policy(td.clone())
        precision = product["gates"].unsqueeze(-1) / product["primitives", "scale"].square()
        mean = (precision * product["primitives", "loc"]).sum(-2) / precision.sum(-2)
        torch.testing.assert_close(product["action"], mean)

        mixture = make("composite-additive")[0].policy(td.clone())
        best = mixture["gates"].argmax(-1)
        torch.testing.assert_close(mixture["action"], mixture["primitives", "loc"][torch.arange(10), best])

        gaussian = make("gaussian")[0].policy(td.clone())
        torch.testing.assert_close(gaussian["action"], gaussian["loc"])


@pytest.mark.parametrize("batch", [(), (3, 5)])
@pytest.mark.parametrize("name", ACTORS)
def test_any_batch_of_states_is_acted_on(name, batch):
    actor, _ = make(name)
    stored = sample(actor, *batch)
    assert stored["action"].shape == (*batch, A)
    assert stored[actor.log_prob].shape == batch


@pytest.mark.parametrize("name", ACTORS)
def test_the_loss_needs_only_what_the_actor_says_it_stores(name):
    actor, parts = make(name)
    critic = value_critic(parts, S, G, num_cells=(8,))
    loss = BoundedClipPPOLoss(actor.trained, critic, bound_coeff=1.0, entropy_bonus=False, functional=False)
    loss.set_keys(action=actor.sampled, sample_log_prob=actor.log_prob)
    with torch.no_grad():
        played = actor.policy(states(32))
    played["advantage"], played["value_target"] = torch.randn(32, 1), torch.randn(32, 1)
    needed = ["observation", "goal", actor.sampled, actor.log_prob, *actor.stored, "advantage", "value_target"]
    report, expected = loss(played.select(*needed)), loss(played)
    for key in ("loss_objective", "loss_critic", "loss_bound"):
        torch.testing.assert_close(report[key], expected[key])
    sum(value for key, value in report.items() if key.startswith("loss_")).backward()
    for part in ("gating", "policy", "goal_input", "encoder", "decoder", "critic"):
        if part in parts:
            assert all(parameter.grad is not None for parameter in parts[part].parameters())


def test_an_actor_names_the_log_probability_after_what_it_samples():
    actor, _ = make("gaussian")
    assert actor.log_prob == "action_log_prob"
    assert replace(actor, sampled="gate_logits").log_prob == "gate_logits_log_prob"
