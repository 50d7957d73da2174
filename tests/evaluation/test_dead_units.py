"""Dead hidden units: every layer of every method is watched, shares are right, and training records them."""

import csv

import pytest
import torch
from smoke import SMOKE
from torch import nn

from torchrl_mcp.evaluation.diagnostics import DeadUnits
from torchrl_mcp.runs import build, experiment
from torchrl_mcp.runs.configuration import compose_run

METHODS = ("mcp", "moe", "latent_space", "finetune", "hierarchical", "option_critic", "scratch")


def configure(*overrides):
    return compose_run(*SMOKE, *overrides)


@pytest.fixture
def networks():
    """Two networks with a layer of 10 units, of which as many are dead as their names say."""
    layers = {name: nn.Sequential(nn.Linear(3, 10), nn.ReLU()) for name in ("one", "three")}
    for layer, dead in zip(layers.values(), (1, 3), strict=True):
        nn.init.constant_(layer[0].bias, 100.0)
        nn.init.constant_(layer[0].bias[:dead], -100.0)
    return nn.ModuleDict(layers)


def test_the_share_of_units_that_no_sample_activates_is_told_for_each_network(networks):
    samples = torch.randn(64, 3)
    shares = DeadUnits(networks)(lambda: [network(samples) for network in networks.values()])
    assert shares == pytest.approx({"dead_units/one": 0.1, "dead_units/three": 0.3})


def test_networks_without_rectifiers_have_no_dead_units():
    network = nn.ModuleDict({"critic": nn.Sequential(nn.Linear(2, 2), nn.Tanh())})
    assert DeadUnits(network)(lambda: network["critic"](torch.zeros(4, 2))) == {}


def test_units_that_one_sample_activates_are_alive_and_few_samples_judge_none(networks):
    watch, samples = DeadUnits(networks), torch.zeros(64, 3)
    with torch.no_grad():
        networks["three"][0].weight.zero_()[:3, 0] = 1.0
    samples[63, 0] = 200.0
    assert watch(lambda: networks["three"](samples)) == {"dead_units/three": 0.0}
    assert watch(lambda: networks["three"](samples[:63])) == {"dead_units/three": 0.0}
    assert watch(lambda: networks["three"](samples[:63].repeat(2, 1))) == pytest.approx({"dead_units/three": 0.3})


@pytest.mark.parametrize("method", METHODS)
def test_every_hidden_layer_of_every_method_is_watched(method, tmp_path):
    task = "heading" if method == "scratch" else "imitation"
    cfg = configure(f"method={method}", f"task={task}", "autocast=false", f"run_dir={tmp_path}")
    source = build.make_source(cfg)
    agent = build.make_agent(cfg, source.env)
    trainer = build.make_trainer(cfg, agent, source, tmp_path)
    layers = [
        module
        for module in agent.parts.modules()
        if isinstance(module, nn.Linear) or type(module).__name__ == "BatchedLinear"
    ]
    outputs = [module for name, module in agent.parts.named_modules() if name.rpartition(".")[2] == "output"]
    heads = len(outputs) + 1  # the critic's
    injections = "goal_input" in agent.parts  # added before the rectifier of another layer
    assert len(trainer.update.dead_units.layers) == len(layers) - heads - injections


def test_training_records_the_share_of_every_network(tmp_path):
    experiment.train(configure("method=mcp", "task=imitation", f"run_dir={tmp_path}"))
    with (tmp_path / "metrics.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            shares = {key: float(value) for key, value in row.items() if key.startswith("dead_units/")}
            assert set(shares) == {"dead_units/gating", "dead_units/primitives", "dead_units/critic"}
            assert all(0 <= share < 1 for share in shares.values())
