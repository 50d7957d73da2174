"""The networks that the configuration builds: as many parameters as the paper's layers have, and the initial spread."""

import pytest
import torch
from hydra.utils import instantiate
from refusals import refused
from torch import nn

from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.modules.primitives import BatchedLinear
from torchrl_mcp.runs.configuration import compose_run

APPENDIX_E = ("width=1.0", "learned_std=false")  # the default preset has half the width and learned noise


@pytest.mark.parametrize("num_primitives", [1, 4, 8, 32])
@pytest.mark.parametrize("mixer", ["multiplicative", "additive"])
@pytest.mark.parametrize("activation", ["sigmoid", "softmax"])
def test_as_configured_the_composite_starts_near_the_standard_deviation_asked_for(
    num_primitives, mixer, activation, states, sizes
):
    cfg = compose_run(f"mixer={mixer}", f"gating={activation}", f"num_primitives={num_primitives}")
    torch.manual_seed(0)
    parts, td = instantiate(cfg.parts)(sizes), states(200)
    parts["observation_normaliser"].update(td["observation"])
    stddev = instantiate(cfg.actor)(parts).trained.get_dist(td).stddev
    # Random last layers spread the deviations of states and actions around it.
    assert stddev.mean().item() == pytest.approx(cfg.primitives.initial_std, rel=0.1)


@pytest.mark.parametrize(
    ("method", "stage", "parameters"),
    [
        # tests/modules has the arithmetic; the goal is that of imitation, 208, or of heading, 2.
        # State and goal enter the critic's 1024 units: (105+208)*1024+1024 + 1024*512+512 + 512*1+1 = 846849.
        # mcp: the goal encoder's 208*512+512 = 107008 in place of 2*512+512 = 1536
        ("mcp", "pretrain", {"gating": 557_320, "primitives": 781_840, "critic": 846_849}),
        ("mcp", "transfer", {"gating": 451_848, "primitives": 781_840, "critic": 635_905}),
        ("scratch", "transfer", {"policy": 644_113, "critic": 635_905}),
        ("finetune", "pretrain", {"policy": 642_065, "goal_input": 212_992, "critic": 846_849}),
        ("finetune", "transfer", {"policy": 642_065, "goal_input": 2_048, "critic": 635_905}),
        ("moe", "pretrain", {"gating": 850_440, "primitives": 772_880, "critic": 846_849}),
        ("moe", "transfer", {"gating": 639_496, "primitives": 772_880, "critic": 635_905}),
        # Decoder: (105+8)*1024+1024 + 1024*512+512 + 512*17+17 = 116736 + 524800 + 8721
        ("latent_space", "pretrain", {"encoder": 88_464, "decoder": 650_257, "critic": 846_849}),
        ("latent_space", "transfer", {"encoder": 643_600, "decoder": 650_257, "critic": 635_905}),
    ],
)
def test_the_configuration_builds_appendix_e_for_the_biped(method, stage, parameters):
    task, goal_dim = {"pretrain": ("imitation", 208), "transfer": ("heading", 2)}[stage]
    cfg = compose_run(f"method={method}", f"stage={stage}", f"task={task}", "character=biped", *APPENDIX_E)
    parts = instantiate(cfg.parts)(Sizes(105, goal_dim, 17))
    instantiate(cfg.critic)(parts, Sizes(105, goal_dim, 17))
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
    assert counts == {"observation_normaliser": 0, "goal_normaliser": 0, **parameters}


@pytest.mark.parametrize(
    ("method", "part"), [("mcp", "primitives"), ("moe", "primitives"), ("option_critic", "options")]
)
def test_std_gain_is_the_factor_on_the_outputs_for_log_standard_deviations(method, part):
    cfg = compose_run(f"method={method}", "task=imitation", "std_gain=0.5", "width=0.05")
    primitives, states = instantiate(cfg.parts)(Sizes(105, 208, 17))[part], torch.randn(10, 105)
    _, before = primitives(states)
    with torch.no_grad():
        primitives.output.bias[:, 17:] += 1.0
    torch.testing.assert_close(primitives(states)[1] / before, torch.full_like(before, 0.5).exp())


# Worked out by hand for a biped (S = 105, A = 17) whose goal has two numbers; a hidden body of 1024-512 on F inputs has
# 1024 F + 1024 + 1024 * 512 + 512 parameters: 633344 for F = 105, 635392 for F = 107.
COUNTS = {
    ("hierarchical", "pretrain"): {"primitives": 7 * (633_344 + 512 * 17 + 17)},
    ("hierarchical", "transfer"): {"primitives": 4_494_455, "gating": 635_392 + 512 * 7 + 7},
    ("option_critic", "pretrain"): {
        "options": 633_344 + 8 * (512 * 34 + 34),
        "terminations": 633_344 + 512 * 8 + 8,
        "critic": 635_392 + 512 * 8 + 8,
    },
}


@pytest.mark.parametrize(("method", "stage"), COUNTS)
def test_parameters_are_as_many_as_the_paper_s_layers_have(method, stage):
    cfg = compose_run(f"method={method}", f"stage={stage}", "character=biped", "task=heading", *APPENDIX_E)
    parts = instantiate(cfg.parts)(Sizes(105, 2, 17))
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
    assert {name: count for name, count in counts.items() if count} == COUNTS[method, stage]


@pytest.mark.parametrize("stage", ["pretrain", "transfer"])
@pytest.mark.parametrize(
    "method", ["mcp", "moe", "latent_space", "finetune", "hierarchical", "option_critic", "scratch"]
)
def test_width_scales_every_hidden_layer_of_every_network(method, stage):
    hidden = {}
    for width in (1.0, 0.5):
        cfg = compose_run(f"method={method}", f"stage={stage}", "task=heading", "character=biped", f"width={width}")
        parts = instantiate(cfg.parts)(Sizes(105, 2, 17))
        instantiate(cfg.critic)(parts, Sizes(105, 2, 17))
        linear = [layer for layer in parts.modules() if isinstance(layer, (nn.Linear, BatchedLinear))]
        hidden[width] = [layer.bias.shape[-1] for layer in linear if layer.bias is not None]
    changed = [(full, half) for full, half in zip(hidden[1.0], hidden[0.5], strict=True) if full != half]
    assert all(full == 2 * half for full, half in changed)
    outputs = {1, 7, 8, 16, 17, 34}  # values, logits, terminations and values of options, latents, actions
    assert all(full in outputs for full, half in zip(hidden[1.0], hidden[0.5], strict=True) if full == half)


def test_a_width_without_units_is_refused():
    refused(lambda: instantiate(compose_run("width=0.0").parts)(Sizes(105, 2, 17)), "width=0.0")
