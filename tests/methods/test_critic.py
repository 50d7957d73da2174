import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.critic import value_critic
from torchrl_mcp.modules import RunningNormaliser


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
    assert [type(layer) for layer in parts["critic"]] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]


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
