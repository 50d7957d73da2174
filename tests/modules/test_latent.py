import pytest
import torch

from torchrl_mcp.modules import GoalEncoder, StateGoalEncoder


@pytest.mark.parametrize(
    ("encoder", "goal_dim", "parameters"),
    [
        # 208*256+256 + 256*128+128 + 128*16+16: 53504 + 32896 + 2064
        pytest.param(GoalEncoder, 208, 88_464, id="pre-training"),
        # (105+2)*1024+1024 + 1024*512+512 + 512*16+16: 110592 + 524800 + 8208
        pytest.param(StateGoalEncoder, 2, 643_600, id="heading"),
    ],
)
def test_they_have_the_parameters_of_section_e7(encoder, goal_dim, parameters):
    network = encoder(105, goal_dim, 8)
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters
    loc, scale = network(torch.zeros(3, 4, 105), torch.zeros(3, 4, goal_dim))
    assert loc.shape == scale.shape == (3, 4, 8)


def test_an_encoder_is_linear_in_its_last_features_for_mean_and_logarithm_of_the_deviation():
    encoder = StateGoalEncoder(3, 2, 4, num_cells=(8, 6))
    observation, goal = torch.randn(10, 3), torch.randn(10, 2)
    first, _, second, _ = encoder.body
    output = encoder.output(second(first(torch.cat([observation, goal], -1)).relu()).relu())
    loc, scale = encoder(observation, goal)
    torch.testing.assert_close(loc, output[:, :4])
    torch.testing.assert_close(scale.log(), output[:, 4:])


@pytest.mark.parametrize(("encoder", "sees_state"), [(GoalEncoder, False), (StateGoalEncoder, True)])
def test_in_pre_training_the_code_is_of_the_goal_alone(encoder, sees_state):
    network, goal = encoder(3, 2, 4), torch.randn(10, 2)
    here, there = network(torch.zeros(10, 3), goal), network(torch.ones(10, 3), goal)
    for a, b in zip(here, there, strict=True):
        assert torch.equal(a, b) != sees_state
    for a, b in zip(here, network(torch.zeros(10, 3), -goal), strict=True):
        assert not torch.equal(a, b)


@pytest.mark.parametrize("encoder", [GoalEncoder, StateGoalEncoder])
def test_codes_stay_float32_under_autocast(encoder):
    with torch.autocast("cpu", torch.bfloat16):
        loc, scale = encoder(3, 2, 4)(torch.randn(10, 3), torch.randn(10, 2))
    assert loc.dtype == scale.dtype == torch.float32


@pytest.mark.parametrize("encoder", [GoalEncoder, StateGoalEncoder])
def test_noise_has_a_lower_bound(encoder):
    network = encoder(3, 2, 4, min_std=0.5)
    torch.nn.init.zeros_(network.output.weight)
    with torch.no_grad():
        network.output.bias.copy_(torch.tensor([1.0, 2.0, 3.0, 4.0, *torch.tensor([0.0, 0.1, 0.7, 2.0]).log()]))
    loc, scale = network(torch.randn(3), torch.randn(2))
    torch.testing.assert_close(loc, torch.tensor([1.0, 2.0, 3.0, 4.0]))
    torch.testing.assert_close(scale, torch.tensor([0.5, 0.5, 0.7, 2.0]))


def test_a_negative_lower_bound_is_refused():
    with pytest.raises(ValueError, match=r"min_std=-0.1 must be a finite number, at least 0"):
        StateGoalEncoder(3, 2, 4, min_std=-0.1)
