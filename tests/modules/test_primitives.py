import math

import pytest
import torch
from refusals import refused
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.nn import functional as F
from torchrl.modules import MLP, IndependentNormal, NormalParamExtractor, ProbabilisticActor

from torchrl_mcp.modules import Primitives
from torchrl_mcp.modules.primitives import BatchedLinear


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(
    ("observation_dim", "action_dim", "num_primitives", "parameters"),
    [
        # Trunk 105*512+512 + 512*256+256 = 185600; per primitive 256*256+256 = 65792 and 256*34+34 = 8738:
        # 185600 + 8*65792 + 8*8738
        pytest.param(105, 17, 8, 781_840, id="biped"),
        # Trunk 27*512+512 + 512*256+256 = 145664; per primitive 65792 and 256*16+16 = 4112:
        # 145664 + 8*65792 + 8*4112
        pytest.param(27, 8, 8, 704_896, id="ant"),
        # 145664 + 65792 + 4112
        pytest.param(27, 8, 1, 215_568, id="ant with one primitive"),
    ],
)
def test_they_have_the_parameters_of_figure_3(observation_dim, action_dim, num_primitives, parameters):
    primitives = Primitives(observation_dim, action_dim, num_primitives)
    assert count(primitives) == parameters
    loc, scale = primitives(torch.zeros(3, 4, observation_dim))
    assert loc.shape == scale.shape == (3, 4, num_primitives, action_dim)


def test_the_trunk_is_followed_by_relus():
    assert [type(layer) for layer in Primitives(27, 8, 8).trunk] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU]


def test_they_compute_figure_3_one_branch_after_the_other():
    primitives = Primitives(3, 2, 4, trunk_cells=(7, 6), branch_cells=5, initial_std=0.5, output_gain=1.0)
    observation = torch.randn(10, 3)
    loc, scale = primitives(observation)

    features = primitives.trunk[2](primitives.trunk[0](observation).relu()).relu()
    for k in range(4):
        hidden = F.linear(features, primitives.branches.weight[k].T, primitives.branches.bias[k]).relu()
        output = F.linear(hidden, primitives.output.weight[k].T, primitives.output.bias[k])
        torch.testing.assert_close(loc[:, k], output[:, :2])
        torch.testing.assert_close(scale[:, k], output[:, 2:].exp())


@pytest.mark.parametrize("initial_std", [0.05, 1.0, 3.0])
def test_with_a_small_gain_every_primitive_starts_at_zero_mean_and_its_initial_std(initial_std):
    loc, scale = Primitives(27, 8, 8, initial_std=initial_std, output_gain=0.01)(torch.randn(100, 27))
    torch.testing.assert_close(loc, torch.zeros_like(loc), atol=0.02, rtol=0)
    torch.testing.assert_close(scale, torch.full_like(scale, initial_std), atol=0, rtol=0.02)


def test_a_gain_slows_down_what_adam_does_to_deviations():
    def change(std_gain):
        torch.manual_seed(0)
        primitives = Primitives(3, 2, 4, trunk_cells=(7, 6), branch_cells=64, std_gain=std_gain)
        states = torch.randn(100, 3)
        optimizer = torch.optim.Adam(primitives.output.parameters(), lr=1e-3)
        _, before = primitives(states)
        before.log().sum().backward()
        optimizer.step()
        return (primitives(states)[1].log() - before.log()).detach()

    whole = change(1.0)
    torch.testing.assert_close(change(0.25), whole / 4, atol=1e-6, rtol=1e-3)
    assert (whole < -2e-3).all()  # a parameter would have moved by 0.001


def test_deviations_begin_alike_with_any_gain():
    _, scale = Primitives(27, 8, 8, initial_std=0.3, output_gain=0.01, std_gain=0.1)(torch.randn(100, 27))
    torch.testing.assert_close(scale, torch.full_like(scale, 0.3), atol=0, rtol=0.02)


@pytest.mark.parametrize("std_gain", [1.0, 0.1])
def test_means_and_standard_deviations_are_rescaled_together(std_gain):
    primitives = Primitives(27, 8, 3, std_gain=std_gain)
    states = torch.randn(10, 27)
    before = primitives(states)
    primitives.rescale(2.5)
    torch.testing.assert_close(primitives(states), (2.5 * before[0], 2.5 * before[1]))


def test_the_branches_differ_and_learn_apart():
    primitives = Primitives(27, 8, 3)
    loc, _ = primitives(torch.randn(10, 27))
    assert not torch.equal(loc[:, 0], loc[:, 1])
    loc[:, 1].sum().backward()
    for layer in (primitives.branches, primitives.output):
        moved = layer.weight.grad.flatten(1).ne(0).any(-1)
        assert moved.tolist() == [False, True, False]


def test_standard_deviations_stay_float32_under_autocast():
    with torch.autocast("cpu", torch.bfloat16):
        _, scale = Primitives(27, 8, 3)(torch.randn(10, 27))
    assert scale.dtype == torch.float32


@pytest.mark.parametrize(
    ("name", "value"),
    [("num_primitives", 0), ("initial_std", 0.0), ("initial_std", -1.0), ("initial_std", math.nan), ("std_gain", 0.0)],
)
def test_impossible_arguments_are_refused_by_name(name, value):
    refused(lambda: Primitives(**{"observation_dim": 27, "action_dim": 8, "num_primitives": 8, name: value}), name)


@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
@pytest.mark.parametrize("shared", [True, False])
def test_a_batched_linear_is_separate_linear_layers(batch, shared):
    layers = BatchedLinear(4, 3, 2)
    separate = [nn.Linear(3, 2) for _ in range(4)]
    for k, linear in enumerate(separate):
        linear.load_state_dict({"weight": layers.weight[k].T, "bias": layers.bias[k]})
    x = torch.randn(*batch, 1 if shared else 4, 3)
    expected = torch.stack([linear(x[..., 0 if shared else k, :]) for k, linear in enumerate(separate)], -2)
    torch.testing.assert_close(layers(x), expected)


def test_a_batched_linear_starts_as_torch_s_linear_layers_do():
    torch.manual_seed(0)
    layers = BatchedLinear(3, 64, 32)
    torch.manual_seed(0)
    for k in range(3):
        linear = nn.Linear(64, 32)
        assert torch.equal(layers.weight[k].T, linear.weight)
        assert torch.equal(layers.bias[k], linear.bias)


@pytest.mark.parametrize(
    ("num_primitives", "parameters"),
    # Trunk 105*1024+1024 + 1024*512+512 = 633344; per primitive 512*34+34 = 17442
    [(8, 772_880), (1, 650_786)],
)
def test_with_linear_heads_they_have_the_parameters_of_section_e6(num_primitives, parameters):
    primitives = Primitives(105, 17, num_primitives, trunk_cells=(1024, 512), branch_cells=0)
    assert count(primitives) == parameters
    loc, scale = primitives(torch.zeros(3, 4, 105))
    assert loc.shape == scale.shape == (3, 4, num_primitives, 17)


def test_linear_heads_are_linear_in_the_trunk_s_features():
    primitives = Primitives(3, 2, 4, trunk_cells=(7, 6), branch_cells=0, initial_std=0.5)
    observation = torch.randn(10, 3)
    loc, scale = primitives(observation)
    features = primitives.trunk[2](primitives.trunk[0](observation).relu()).relu()
    for k in range(4):
        output = F.linear(features, primitives.output.weight[k].T, primitives.output.bias[k])
        torch.testing.assert_close(loc[:, k], output[:, :2])
        torch.testing.assert_close(scale[:, k], output[:, 2:].exp())


class Posture(nn.Module):
    """A policy without a hidden layer, whose standard deviation is one number."""

    def __init__(self):
        super().__init__()
        self.loc = nn.Parameter(torch.tensor([0.3, -0.4]))

    def forward(self, observation):
        return self.loc.expand(*observation.shape[:-1], 2), torch.tensor(0.2)


@pytest.fixture
def actor(tmp_path):
    """An actor of TorchRL from a file."""
    network = nn.Sequential(MLP(5, 4, num_cells=[8]), NormalParamExtractor())
    module = TensorDictModule(network, in_keys=[("seen", "observation")], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(module, in_keys=["loc", "scale"], distribution_class=IndependentNormal)
    torch.save(actor, tmp_path / "actor.pt")
    return torch.load(tmp_path / "actor.pt", weights_only=False)


@pytest.mark.parametrize("batch", [(), (7,), (2, 3)])
def test_policies_of_different_networks_are_primitives_as_they_are(batch, actor):
    linear = nn.Sequential(nn.Linear(5, 4), NormalParamExtractor())
    state = torch.randn(*batch, 5)
    loc, scale = Primitives.from_policies([actor, linear, Posture()])(state)
    assert loc.shape == scale.shape == (*batch, 3, 2)
    distribution = actor.get_dist(TensorDict({("seen", "observation"): state}, batch))
    torch.testing.assert_close((loc[..., 0, :], scale[..., 0, :]), (distribution.mean, distribution.stddev))
    torch.testing.assert_close((loc[..., 1, :], scale[..., 1, :]), linear(state))
    torch.testing.assert_close(loc[..., 2, :], torch.tensor([0.3, -0.4]).expand(*batch, 2))
    assert (scale[..., 2, :] == 0.2).all()


def test_policies_keep_their_parameters_and_can_be_frozen(actor):
    policies = [actor, Posture()]
    primitives = Primitives.from_policies(policies)
    assert {*primitives.parameters()} == {parameter for policy in policies for parameter in policy.parameters()}
    loc, _ = primitives.requires_grad_(False)(torch.randn(4, 5))
    assert not loc.requires_grad


@pytest.mark.parametrize(
    ("policies", "name"),
    [
        (lambda: [], "policies"),
        (lambda: [Posture(), nn.Linear(5, 2)], "policy 1"),
        (lambda: [Posture(), nn.Sequential(nn.Linear(5, 6), NormalParamExtractor())], "(4, 3)"),
    ],
)
def test_policies_that_cannot_be_composed_are_refused(policies, name):
    refused(lambda: Primitives.from_policies(policies())(torch.randn(4, 5)), name)
