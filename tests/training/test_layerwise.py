"""Adam with steps by the inputs of each layer: sizes of steps, and units that stay alive."""

from itertools import pairwise
from statistics import fmean

import pytest
import torch
from torch import nn

from torchrl_mcp.evaluation.diagnostics import DeadUnits
from torchrl_mcp.training.layerwise import layerwise_adam


def mlp(*sizes):
    layers = [module for pair in pairwise(sizes) for module in (nn.Linear(*pair), nn.ReLU())]
    return nn.Sequential(*layers[:-1])


def test_the_first_step_of_each_layer_has_its_size():
    """The first step of Adam has the step size, whatever the gradient (Kingma and Ba, 2015, Section 2.1)."""
    network = mlp(16, 128, 32, 1)
    optimizer = layerwise_adam(network.parameters(), lr=1e-3, inputs=32, fused=False)
    before = [parameter.detach().clone() for parameter in network.parameters()]
    for parameter in network.parameters():
        parameter.grad = torch.randn_like(parameter)
    optimizer.step()
    gone = [(new - old).abs().median().item() for old, new in zip(before, network.parameters(), strict=True)]
    weights, biases = gone[::2], gone[1::2]
    assert weights == pytest.approx([1e-3, 0.25e-3, 1e-3], rel=1e-3)  # of 16, 128 and 32 inputs
    assert biases == pytest.approx([1e-3] * 3, rel=1e-3)


def test_without_a_bound_all_layers_have_equal_steps():
    (group,) = layerwise_adam(mlp(16, 128, 1).parameters(), lr=1e-3, inputs=float("inf"), fused=False).param_groups
    assert group["lr"] == 1e-3


def test_arguments_reach_adam():
    optimizer = layerwise_adam(mlp(2, 64, 1).parameters(), lr=1e-3, inputs=32, fused=False, betas=(0.5, 0.6))
    assert type(optimizer) is torch.optim.Adam
    assert {group["betas"] for group in optimizer.param_groups} == {(0.5, 0.6)}


def dead_units(make_optimizer, seed):
    """Share of dead units after 100 steps of regression on 4,096 samples of 100 numbers."""
    torch.manual_seed(seed)
    network = mlp(100, 512, 256, 1)
    optimizer = make_optimizer(network.parameters())
    inputs = torch.randn(4096, 100)
    targets = 0.1 * inputs[:, :1].relu() + 0.05
    for index in torch.randint(len(inputs), (100, 512)):
        optimizer.zero_grad()
        (network(inputs[index]) - targets[index]).square().mean().backward()
        optimizer.step()
    return DeadUnits(nn.ModuleDict({"critic": network}))(lambda: network(inputs))["dead_units/critic"]


def test_units_stay_alive_that_die_with_equal_steps():
    def mean_share(make_optimizer):
        return fmean(dead_units(make_optimizer, seed) for seed in range(4))

    # Over seeds, the share has a mean of 0.24 and a standard deviation of 0.08 with equal steps.
    assert mean_share(lambda parameters: layerwise_adam(parameters, lr=1e-3, inputs=32, fused=False)) < 0.05
    assert mean_share(lambda parameters: torch.optim.Adam(parameters, lr=1e-3)) > 0.05
