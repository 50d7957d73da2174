import pytest
import torch
from refusals import refused
from torch import nn

from torchrl_mcp.modules import GaussianPolicy, InjectedPolicy
from torchrl_mcp.modules.gaussian import restart_noise


@pytest.mark.parametrize(
    ("observation_dim", "goal_dim", "action_dim", "parameters"),
    [
        # (105+2)*1024+1024 + 1024*512+512 + 512*17+17: 110592 + 524800 + 8721
        pytest.param(105, 2, 17, 644_113, id="biped"),
        # (27+2)*1024+1024 + 1024*512+512 + 512*8+8: 30720 + 524800 + 4104
        pytest.param(27, 2, 8, 559_624, id="ant"),
    ],
)
def test_it_has_the_parameters_of_section_e2(observation_dim, goal_dim, action_dim, parameters):
    policy = GaussianPolicy(observation_dim, goal_dim, action_dim)
    assert sum(parameter.numel() for parameter in policy.parameters()) == parameters
    assert [type(layer) for layer in policy.body] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU]
    loc, scale = policy(torch.zeros(3, 4, observation_dim), torch.zeros(3, 4, goal_dim))
    assert loc.shape == scale.shape == (3, 4, action_dim)


def test_its_mean_is_a_network_over_state_and_goal():
    policy = GaussianPolicy(3, 2, 4, num_cells=(8, 6), output_gain=1.0)
    observation, goal = torch.randn(10, 3), torch.randn(10, 2)
    hidden = policy.body[2](policy.body[0](torch.cat([observation, goal], -1)).relu()).relu()
    torch.testing.assert_close(policy(observation, goal)[0], policy.output(hidden))


@pytest.mark.parametrize(("std", "expected"), [(0.3, [0.3, 0.3, 0.3]), ([0.1, 0.2, 0.5], [0.1, 0.2, 0.5])])
def test_its_standard_deviation_is_given_and_does_not_learn(std, expected):
    policy = GaussianPolicy(27, 2, 3, std=std)
    _, scale = policy(torch.randn(10, 27), torch.randn(10, 2))
    torch.testing.assert_close(scale, torch.tensor(expected).expand(10, 3))
    assert not scale.requires_grad
    assert "scale.state_independent_scale" in policy.state_dict()


@pytest.mark.parametrize("network", [GaussianPolicy, InjectedPolicy])
def test_a_standard_deviation_that_learns_shrinks_where_noise_costs_reward(network):
    torch.manual_seed(0)
    injected = network is InjectedPolicy
    policy = network(3, *([] if injected else [2]), 2, num_cells=(8, 6), std=[0.1, 0.2], learned_std=True)
    inputs = torch.randn(64, 3), torch.zeros(()) if injected else torch.randn(64, 2)
    loc, scale = policy(*inputs)
    torch.testing.assert_close(scale, torch.tensor([0.1, 0.2]).expand(64, 2))
    action = loc + scale * torch.randn(64, 2)
    advantage = -(action - loc).square().sum(-1).detach()
    surrogate = torch.distributions.Normal(loc, scale).log_prob(action.detach()).sum(-1) * (
        advantage - advantage.mean()
    )
    (-surrogate.mean()).backward()
    torch.optim.SGD(policy.parameters(), lr=1.0).step()
    assert (policy(*inputs)[1] < scale).all()


@pytest.mark.parametrize("std", [0.0, 1e-5, -0.1, float("nan"), [0.1, 0.2], [0.1, -0.1, 0.1]])
def test_an_impossible_standard_deviation_is_refused(std):
    for make in (lambda: GaussianPolicy(27, 2, 3, std=std), lambda: InjectedPolicy(27, 3, std=std)):
        refused(make, "std", str(std))
    if std == 1e-5:
        refused(lambda: restart_noise(GaussianPolicy(5, 2, 3), std), "std", "1e-05")


@pytest.mark.parametrize("learned", [True, False])
def test_noise_that_begins_anew_has_the_standard_deviation_given_and_the_same_mean(learned):
    policy = GaussianPolicy(5, 2, 3, std=0.02, learned_std=learned)
    inputs = torch.randn(10, 5), torch.randn(10, 2)
    before, _ = policy(*inputs)
    restart_noise(nn.ModuleDict({"policy": policy, "other": nn.Linear(2, 2)}), 0.1)
    loc, scale = policy(*inputs)
    assert torch.equal(loc, before)
    torch.testing.assert_close(scale, torch.full((10, 3), 0.1))
    assert scale.requires_grad == learned
