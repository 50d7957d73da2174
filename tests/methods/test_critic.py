from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP

from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.critic import value_critic, value_network
from torchrl_mcp.methods.option_critic import option_critic_parts, option_values
from torchrl_mcp.methods.options import Terminations
from torchrl_mcp.modules import Primitives, RunningNormaliser


def normalisers(observation_dim, goal_dim):
    return nn.ModuleDict(
        {
            "observation_normaliser": RunningNormaliser(observation_dim),
            "goal_normaliser": RunningNormaliser(goal_dim),
        }
    )


@pytest.mark.parametrize(
    ("observation_dim", "goal_dim", "parameters"),
    [
        # (105+2)*1024+1024 + 1024*512+512 + 512*1+1: 110592 + 524800 + 513
        pytest.param(105, 2, 635_905, id="biped"),
        # (27+2)*1024+1024 = 30720 in place of 110592
        pytest.param(27, 2, 556_033, id="ant"),
    ],
)
def test_it_has_the_parameters_of_section_e1(observation_dim, goal_dim, parameters):
    parts = normalisers(observation_dim, goal_dim)
    critic = value_critic(parts, Sizes(observation_dim, goal_dim, 17))
    assert sum(parameter.numel() for parameter in critic.parameters()) == parameters
    kinds = [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert all(isinstance(layer, kind) for layer, kind in zip(parts["critic"], kinds, strict=True))


def test_it_values_the_normalised_state_and_goal_of_any_batch():
    parts = normalisers(3, 2)
    critic = value_critic(parts, Sizes(3, 2, 1), num_cells=(8, 6))
    observation, goal = 4 + 3 * torch.randn(5, 7, 3), torch.randn(5, 7, 2)
    parts["observation_normaliser"].update(observation)
    parts["goal_normaliser"].update(goal)
    value = critic(TensorDict(observation=observation, goal=goal, batch_size=[5, 7]))["state_value"]

    def standardised(x):
        return (x - x.mean((0, 1))) / x.std((0, 1), correction=0)

    first, _, second, _, last = parts["critic"]
    hidden = first(torch.cat([standardised(observation), standardised(goal)], -1)).relu()
    torch.testing.assert_close(value, last(second(hidden).relu()), atol=1e-5, rtol=1e-4)


def test_its_weights_have_the_names_and_first_values_of_torchrl_s_network():
    torch.manual_seed(0)
    network = value_network(Sizes(3, 2, 1), 4, num_cells=(8, 6), width=1.0)
    torch.manual_seed(0)
    expected = MLP(in_features=5, out_features=4, num_cells=[8, 6], activation_class=nn.ReLU)
    network.load_state_dict(expected.state_dict())  # as saved networks are loaded
    torch.manual_seed(0)
    unsaved = value_network(Sizes(3, 2, 1), 4, num_cells=(8, 6), width=1.0)
    assert all(torch.equal(unsaved.state_dict()[name], value) for name, value in expected.state_dict().items())
    state, goal = torch.randn(7, 3), torch.randn(7, 2)
    assert torch.equal(network(state, goal), expected(state, goal))


def option_critic():
    """Return the parts of the option-critic with three options, and its critic."""
    sizes = Sizes(3, 2, 1)
    options = partial(Primitives, trunk_cells=(8,), branch_cells=0)
    terminations = partial(Terminations, num_cells=(8,), initial=0.1)
    parts = option_critic_parts(sizes, options=options, terminations=terminations, values_cells=(8, 6), num_options=3)
    return parts, option_values(parts, sizes)


def plain_critic():
    """Return the parts of a critic, and the critic."""
    parts = normalisers(3, 2)
    return parts, value_critic(parts, Sizes(3, 2, 1), num_cells=(8, 6))


@pytest.mark.parametrize(
    ("make", "key"), [(plain_critic, "state_value"), (option_critic, "option_values")], ids=["state", "options"]
)
def test_under_autocast_only_the_hidden_layers_are_rounded_to_bfloat16(make, key):
    torch.manual_seed(0)
    parts, critic = make()
    states = TensorDict(observation=torch.randn(50, 3), goal=torch.randn(50, 2), batch_size=[50])
    first, _, second, _, last = parts["critic"]
    with torch.autocast("cpu", torch.bfloat16):
        values = critic(states)[key]
        hidden = second(first(torch.cat([states["observation"], states["goal"]], -1)).relu()).relu()
    assert hidden.dtype == torch.bfloat16
    expected = hidden.double() @ last.weight.double().T + last.bias.double()
    torch.testing.assert_close(values, expected.float())
    values.sum().backward()
    torch.testing.assert_close(last.weight.grad, hidden.float().sum(0).expand_as(last.weight))
