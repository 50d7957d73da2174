"""What methods combine at random, against networks whose outputs are known."""

import pytest
import torch
from torch import nn
from torch.distributions import Normal

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.methods import hierarchical, option_critic
from torchrl_mcp.methods.latent_space import random_latents
from torchrl_mcp.methods.mcp import random_weights

N, K, A, L = 50, 3, 2, 4


def generator():
    return torch.Generator().manual_seed(0)


class Known(nn.Module):
    """A network of a known function."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *inputs):
        return self.function(*inputs)


def named(name, function):
    return nn.ModuleDict({name: Known(function)})


def test_random_weights_are_held_and_play_the_mean_of_the_weighted_product():
    loc, scale, gates = torch.randn(N, K, A), torch.rand(N, K, A) + 0.5, torch.rand(N, K)
    precision = gates.unsqueeze(-1) / scale.square()
    expected = (precision * loc).sum(1) / precision.sum(1)
    logits = []
    explore = random_weights(
        named("primitives", lambda state: (loc + state, scale)),
        N,
        generator(),
        num_primitives=K,
        gate_activation=lambda drawn: logits.append(drawn) or gates,
        distribution_class=MultiplicativeGaussian,
    )
    for state in (0.0, 1.0):
        torch.testing.assert_close(explore(torch.tensor(state)), expected + state)
    (drawn,) = logits
    assert drawn.shape == (N, K)
    assert drawn.std() == pytest.approx(1.0, abs=0.15)


def test_random_latents_are_held_and_decoded_into_the_mean_action():
    explore = random_latents(named("decoder", lambda state, w: (state + w, None)), N, generator(), latent_dim=L)
    latents = explore(torch.zeros(N, L))
    torch.testing.assert_close(explore(torch.ones(N, L)), latents + 1)
    assert Normal(0.0, 1.0).cdf(latents).mean() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(
    ("method", "parts"),
    [
        (hierarchical, named("primitives", lambda state, option: (option, None))),
        (option_critic, named("options", lambda state: (torch.arange(K).expand(N, K).unsqueeze(-1),) * 2)),
    ],
    ids=["hierarchical", "option_critic"],
)
def test_a_random_sequence_lets_each_primitive_act_for_a_while(method, parts):
    explore = method.random_sequence(parts, N, generator(), num_options=K, steps=4)
    options = torch.stack([explore(torch.zeros(N, 1)).flatten() for _ in range(40)]).unflatten(0, (10, 4))
    assert (options == options[:, :1]).all()
    shares = options[:, 0].flatten().bincount() / 500
    assert shares == pytest.approx([1 / 3] * 3, abs=0.06)
    changes = (options[1:, 0] != options[:-1, 0]).float().mean()
    assert changes == pytest.approx(2 / 3, abs=0.07)
