from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian
from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.finetune import injected_actor, injected_parts
from torchrl_mcp.methods.latent_space import latent_actor, latent_parts
from torchrl_mcp.methods.mcp import composite_actor, composite_parts, weights_actor
from torchrl_mcp.methods.scratch import gaussian_actor, gaussian_parts
from torchrl_mcp.modules import Gating, GaussianPolicy, GoalEncoder, InjectedPolicy, Primitives

GATING = partial(Gating, state_cells=(16, 8), goal_cells=(16, 8), joint_cells=(8,))
PRIMITIVES = partial(Primitives, trunk_cells=(16, 8), branch_cells=8)


@pytest.fixture(scope="session")
def sizes():
    """How many numbers an observation, a goal and an action have."""
    return Sizes(6, 2, 3)


@pytest.fixture(scope="session")
def composite(sizes):
    """Small parts of a composite."""

    def composite(*, gate_activation, distribution_class, num_primitives=4, gain=1.0, initial_std=0.3, **settings):
        return composite_parts(
            sizes,
            gating=partial(GATING, output_gain=gain),
            gate_activation=gate_activation,
            primitives=partial(PRIMITIVES, output_gain=gain),
            num_primitives=num_primitives,
            distribution_class=distribution_class,
            initial_std=initial_std,
            **settings,
        )

    return composite


@pytest.fixture(scope="session")
def make_actor(sizes, composite):
    """An actor by name and its parts, with normalisers that have seen data."""

    def make_actor(name):
        torch.manual_seed(0)
        mixer = AdditiveGaussian if "additive" in name else MultiplicativeGaussian
        heads = {"gate_activation": nn.Sigmoid(), "distribution_class": mixer}
        frozen = ["primitives", "observation_normaliser"] if "frozen" in name or name == "weights" else []
        if name == "gaussian":
            parts = gaussian_parts(sizes, policy=partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0))
            actor = gaussian_actor(parts)
        elif name == "injected":
            policy = partial(InjectedPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)
            parts = injected_parts(sizes, policy=policy, blind=False)
            actor = injected_actor(parts)
        elif name == "latent":
            decoder = partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)
            parts = latent_parts(sizes, encoder=partial(GoalEncoder, num_cells=(8,)), decoder=decoder, latent_dim=2)
            actor = latent_actor(parts)
        elif name == "weights":
            parts = composite(**heads)
            actor = weights_actor(parts, **heads, logits_std=0.2, frozen=frozen)
        else:
            parts = composite(**heads)
            actor = composite_actor(parts, **heads, frozen=frozen)
        for part in frozen:
            parts[part].requires_grad_(False)
        parts["observation_normaliser"].update(2 + 3 * torch.randn(50, sizes.observation))
        parts["goal_normaliser"].update(torch.randn(50, sizes.goal))
        return actor, parts

    return make_actor


@pytest.fixture(scope="session")
def states(sizes):
    """The same random states and goals at every call."""

    def states(*batch, seed=1):
        generator = torch.Generator().manual_seed(seed)
        observation = 2 + 3 * torch.randn(*batch, sizes.observation, generator=generator)
        goal = torch.randn(*batch, sizes.goal, generator=generator)
        return TensorDict(observation=observation, goal=goal, batch_size=batch)

    return states


@pytest.fixture(scope="session")
def sample(states):
    """What collection stores: the inputs, the random variable, its log-probability, and what the actor asks for."""

    def sample(actor, *batch):
        with torch.no_grad():
            played = actor.policy(states(*batch))
        return played.select("observation", "goal", "action", actor.sampled, actor.log_prob, *actor.stored)

    return sample
