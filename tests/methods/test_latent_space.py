from functools import partial

import pytest
import torch
from hydra.utils import instantiate
from refusals import refused
from tensordict import TensorDict
from torch.distributions import Independent, Normal
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.latent_space import LATENT, NOISE, latent_actor, latent_parts, latents_actor
from torchrl_mcp.modules import GaussianPolicy, GoalEncoder, StateGoalEncoder
from torchrl_mcp.runs.configuration import compose_run

S, G, A, L = 6, 2, 3, 4


def make(encoder=StateGoalEncoder, frozen=()):
    torch.manual_seed(0)
    parts = latent_parts(
        Sizes(S, G, A),
        encoder=partial(encoder, num_cells=(16, 8)),
        decoder=partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0),
        latent_dim=L,
    )
    for part in frozen:
        parts[part].requires_grad_(False)
    return latent_actor(parts, frozen=frozen), parts


def states(*batch):
    return TensorDict(observation=torch.randn(*batch, S), goal=torch.randn(*batch, G), batch_size=batch)


def test_the_latent_is_drawn_from_the_encoder_s_gaussian():
    actor, parts = make()
    td = states(1).expand(20_000).clone()
    with torch.no_grad():
        latent = actor.policy(td)[LATENT]
        loc, scale = parts["encoder"](*(parts[f"{key}_normaliser"](td[key][0]) for key in ("observation", "goal")))
    # Five standard errors.
    torch.testing.assert_close(latent.mean(0), loc, atol=0.05, rtol=0)
    torch.testing.assert_close(latent.std(0), scale, atol=0.04, rtol=0)


def test_the_action_is_gaussian_around_the_decoder_s_mean_at_the_stored_noise():
    actor, parts = make()
    with torch.no_grad():
        played = actor.policy(states(20))
        observation, goal = (parts[f"{key}_normaliser"](played[key]) for key in ("observation", "goal"))
        loc, scale = parts["encoder"](observation, goal)
        mean, _ = parts["decoder"](observation, loc + scale * played[NOISE])
    log_prob = Independent(Normal(mean, 0.3), 1).log_prob(played["action"])
    torch.testing.assert_close(played["action_log_prob"], log_prob)


@pytest.mark.parametrize("encoder", [GoalEncoder, StateGoalEncoder])
def test_the_decoder_learns_of_the_goal_through_the_latent_variable_alone(encoder):
    actor, _ = make(encoder)
    td = states(10)
    td["goal"].requires_grad_()
    played = actor.policy(td)
    (through,) = torch.autograd.grad(played["loc"].sum(), td["goal"], retain_graph=True)
    assert through.ne(0).any(-1).all()
    # With the latent variable held, no way is left.
    (gradient,) = torch.autograd.grad(played["loc"].sum(), played[LATENT], retain_graph=True)
    (explained,) = torch.autograd.grad(played[LATENT], td["goal"], gradient)
    assert torch.equal(through, explained)


def test_goals_of_one_code_are_one_to_the_policy():
    actor, parts = make()
    torch.nn.init.zeros_(parts["encoder"].output.weight)
    td = states(10)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        here, there = actor.policy(td.clone()), actor.policy(td.clone().set("goal", torch.randn(10, G)))
    assert torch.equal(here["action"], there["action"])


def test_without_exploration_the_mean_code_and_the_mean_action_are_played():
    actor, parts = make()
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        played = actor.policy(states(10))
        observation, goal = (parts[f"{key}_normaliser"](played[key]) for key in ("observation", "goal"))
        loc, _ = parts["encoder"](observation, goal)
        assert torch.equal(played[LATENT], loc)
        assert torch.equal(played["action"], parts["decoder"](observation, loc)[0])


def test_noise_is_drawn_anew_in_every_step_whatever_was_carried_over():
    actor, _ = make()
    td = states(10)
    td[NOISE] = torch.zeros(10, L)
    with torch.no_grad():
        first = actor.policy(td)[NOISE].clone()
        second = actor.policy(td)[NOISE]
    assert first.ne(0).all()
    assert first.ne(second).all()


def test_a_frozen_decoder_passes_gradients_on_to_the_encoder():
    actor, parts = make(frozen=["decoder", "observation_normaliser"])
    with torch.no_grad():
        stored = actor.policy(states(20))
    actor.trained.get_dist(stored).log_prob(stored["action"]).sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in parts["encoder"].parameters())
    assert all(parameter.grad is None for parameter in parts["decoder"].parameters())


def test_a_latent_space_without_dimensions_and_a_decoder_that_learns_over_latents_are_refused():
    networks = {"encoder": GoalEncoder, "decoder": GaussianPolicy}
    refused(lambda: latent_parts(Sizes(S, G, A), **networks, latent_dim=0), "latent_dim")
    refused(lambda: latents_actor(make()[1]), "decoder", "transfer.freeze", "exploration=action")


def test_exploration_over_the_latent_variable_draws_it_and_plays_the_decoder_s_mean():
    frozen = ["decoder", "observation_normaliser"]
    parts = make(frozen=frozen)[1]
    actor = latents_actor(parts, frozen=frozen)
    assert (actor.sampled, actor.log_prob) == ("latents", "latents_log_prob")
    with torch.no_grad():
        stored = actor.policy(states(50))
        observation, goal = (parts[f"{key}_normaliser"](stored[key]) for key in ("observation", "goal"))
        loc, scale = parts["encoder"](observation, goal)
    assert torch.equal(stored["action"], parts["decoder"](observation, stored["latents"])[0])
    score = Independent(Normal(loc, scale), 1).log_prob(stored["latents"])
    torch.testing.assert_close(stored["latents_log_prob"], score)
    actor.trained.get_dist(stored).log_prob(stored["latents"]).sum().backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in parts["encoder"].parameters())
    assert all(parameter.grad is None for parameter in parts["decoder"].parameters())
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        played = actor.policy(states(10))
    assert torch.equal(played["latents"], played["latent", "loc"])


def test_the_noise_of_the_latent_variable_can_be_fixed():
    frozen = ["decoder", "observation_normaliser"]
    parts = make(frozen=frozen)[1]
    actor = latents_actor(parts, latent_std=0.7, frozen=frozen)
    with torch.no_grad():
        stored = actor.policy(states(20))
    score = Independent(Normal(stored["latent", "loc"], 0.7), 1).log_prob(stored["latents"])
    torch.testing.assert_close(stored["latents_log_prob"], score)


@pytest.mark.parametrize(
    ("words", "least"),
    [
        (["task=dribble", "stage=transfer"], 0.1),
        (["task=dribble", "stage=transfer", "exploration.min_latent_std=0.2"], 0.2),
        (["task=dribble", "stage=transfer", "preset=paper"], 0.0),
        (["task=imitation"], 0.0),
    ],
)
def test_the_noise_of_the_latent_variable_is_bounded_where_it_explores(words, least):
    cfg = compose_run("method=latent_space", *words)
    assert instantiate(cfg.parts.encoder)(3, 2, 4).min_std == least
