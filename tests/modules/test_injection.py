import pytest
import torch
from refusals import refused

from torchrl_mcp.modules import GaussianPolicy, InjectedPolicy, InputInjection


def count(*modules):
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def test_policy_and_injected_goal_have_the_parameters_of_the_scratch_model():
    # 105*1024+1024 + 1024*512+512 + 512*17+17: 108544 + 524800 + 8721; and 2*1024
    policy, injection = InjectedPolicy(105, 17), InputInjection(2, 1024)
    assert (count(policy), count(injection)) == (642_065, 2_048)
    assert count(policy, injection) == count(GaussianPolicy(105, 2, 17))


def test_together_they_compute_the_scratch_model():
    torch.manual_seed(0)
    policy = InjectedPolicy(3, 4, num_cells=(8, 6, 5), std=[0.1, 0.2, 0.3, 0.4], output_gain=1.0)
    injection, scratch = InputInjection(2, 8), GaussianPolicy(3, 2, 4, num_cells=(8, 6, 5), std=0.3)
    with torch.no_grad():
        injection.weight.normal_()
        scratch.body[0].weight.copy_(torch.cat([policy.input.weight, injection.weight], -1))
        scratch.body[0].bias.copy_(policy.input.bias)
        for mine, theirs in ((policy.body[0], 2), (policy.body[2], 4)):
            scratch.body[theirs].load_state_dict(mine.state_dict())
        scratch.output.load_state_dict(policy.output.state_dict())
    observation, goal = torch.randn(10, 3), torch.randn(10, 2)
    loc, scale = policy(observation, injection(goal))
    torch.testing.assert_close(loc, scratch(observation, goal)[0])
    torch.testing.assert_close(scale, torch.tensor([0.1, 0.2, 0.3, 0.4]).expand(10, 4))


@pytest.mark.parametrize("goal_dim", [1, 2, 208])
@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
def test_new_inputs_change_no_bit_of_the_output_and_learn_at_once(goal_dim, autocast):
    torch.manual_seed(0)
    policy, injection = InjectedPolicy(105, 17, output_gain=1.0), InputInjection(goal_dim, 1024)
    observation, goal = torch.randn(64, 105), 10 * torch.randn(64, goal_dim)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        without = policy(observation, torch.zeros(()))[0]
        loc = policy(observation, injection(goal))[0]
    assert torch.equal(loc, without)
    loc.float().square().sum().backward()
    # Units that are off in all 64 states learn nothing.
    assert injection.weight.grad.ne(0).float().mean() > 0.9


def test_a_network_without_a_second_layer_is_refused():
    refused(lambda: InjectedPolicy(3, 2, num_cells=(8,)), "num_cells")
