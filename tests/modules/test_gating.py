import copy
import math

import pytest
import torch
from refusals import refused
from torch import nn
from torch.nn import functional as F

from torchrl_mcp.modules import Gating, JointGating, Primitives, StateGoalEncoder, gate_diagnostics


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(
    ("observation_dim", "goal_dim", "num_primitives", "parameters"),
    [
        # State 105*512+512 + 512*256+256, goal 2*512+512 + 512*256+256, joint 512*256+256, output 256*8+8:
        # 54272 + 131328 + 1536 + 131328 + 131328 + 2056
        pytest.param(105, 2, 8, 451_848, id="biped"),
        # The state is smaller: 27*512+512 = 14336 in place of 54272
        pytest.param(27, 2, 8, 411_912, id="ant"),
        # One gate: 256*1+1 = 257 in place of 2056
        pytest.param(27, 2, 1, 410_113, id="ant with one primitive"),
    ],
)
def test_it_has_the_parameters_of_figure_3(observation_dim, goal_dim, num_primitives, parameters):
    gating = Gating(observation_dim, goal_dim, num_primitives)
    assert count(gating) == parameters
    logits = gating(torch.zeros(3, 4, observation_dim), torch.zeros(3, 4, goal_dim))
    assert logits.shape == (3, 4, num_primitives)


def test_every_hidden_layer_is_followed_by_a_relu():
    gating = Gating(27, 2, 8)
    for encoder in (gating.state_encoder, gating.goal_encoder):
        assert [type(layer) for layer in encoder] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU]
    assert [type(layer) for layer in gating.joint] == [nn.Linear, nn.ReLU]
    assert type(gating.output) is nn.Linear


def test_it_computes_figure_3():
    gating = Gating(3, 2, 4, state_cells=(7, 6), goal_cells=(5, 4), joint_cells=(8,), output_gain=1.0)
    observation, goal = torch.randn(10, 3), torch.randn(10, 2)

    def layer(name, x):
        return F.linear(x, gating.get_parameter(f"{name}.weight"), gating.get_parameter(f"{name}.bias"))

    state = layer("state_encoder.2", layer("state_encoder.0", observation).relu()).relu()
    target = layer("goal_encoder.2", layer("goal_encoder.0", goal).relu()).relu()
    logits = layer("output", layer("joint.0", torch.cat([state, target], -1)).relu())
    torch.testing.assert_close(gating(observation, goal), logits)


def test_it_sees_state_and_goal():
    observation, goal = torch.randn(6, 27, requires_grad=True), torch.randn(6, 2, requires_grad=True)
    gradients = torch.autograd.grad(Gating(27, 2, 8)(observation, goal).sum(), [observation, goal])
    assert all(gradient.ne(0).any(-1).all() for gradient in gradients)


def test_a_small_output_gain_starts_all_gates_alike():
    observation, goal = torch.randn(100, 27), torch.randn(100, 2)
    gates = Gating(27, 2, 8, output_gain=0.01)(observation, goal).sigmoid()
    torch.testing.assert_close(gates, torch.full_like(gates, 0.5), atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("gates", "expected"),
    [
        pytest.param(
            [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]],
            {"sum": 1, "saturation": 1, "entropy": 0, "effective_primitives": 1, "usage_0": 0.5, "usage_3": 0},
            id="one-hot",
        ),
        pytest.param(
            [[0.7] * 4] * 3,
            {"sum": 2.8, "saturation": 0, "entropy": math.log(4), "effective_primitives": 4, "usage_2": 0.7},
            id="uniform",
        ),
        pytest.param(
            [[0.5, 0.5], [0.02, 0.98]],
            {
                "sum": 1,
                "saturation": 0.5,
                "entropy": (math.log(2) - 0.02 * math.log(0.02) - 0.98 * math.log(0.98)) / 2,
                "effective_primitives": (2 + 0.02**-0.02 * 0.98**-0.98) / 2,
                "usage_0": 0.26,
                "usage_1": 0.74,
            },
            id="one row shared, one decided",
        ),
        pytest.param(
            [[0.0, 0.0, 0.0]] * 2,
            {"sum": 0, "saturation": 1, "entropy": 0, "effective_primitives": 1, "usage_0": 0},
            id="all closed",
        ),
    ],
)
def test_diagnostics_of_hand_made_gates(gates, expected):
    diagnostics = gate_diagnostics(torch.tensor(gates))
    for name, value in expected.items():
        assert diagnostics[name].item() == pytest.approx(value, abs=1e-6), name


def test_diagnostics_are_scalars_for_any_batch_and_carry_no_gradient():
    gates = torch.rand(2, 5, 3, dtype=torch.bfloat16, requires_grad=True)
    diagnostics = gate_diagnostics(gates)
    assert {name for name in diagnostics if name.startswith("usage")} == {"usage_0", "usage_1", "usage_2"}
    for name, value in diagnostics.items():
        assert value.shape == (), name
        assert value.isfinite(), name
        assert not value.requires_grad, name
        torch.testing.assert_close(value, gate_diagnostics(gates.reshape(10, 3))[name])
    assert gate_diagnostics(torch.tensor([0.25, 0.75]))["sum"] == 1


@pytest.mark.parametrize("gate", [Gating, JointGating])
@pytest.mark.parametrize("num_primitives", [0, 2.5])
def test_a_gate_over_an_impossible_number_of_primitives_is_refused(gate, num_primitives):
    refused(lambda: gate(3, 2, num_primitives), f"num_primitives={num_primitives}")


@pytest.mark.parametrize("num_cells", [(), [], 64])
def test_a_gate_without_a_list_of_layers_is_refused(num_cells):
    refused(lambda: JointGating(3, 2, 4, num_cells=num_cells), f"num_cells={num_cells}")


def test_the_width_of_saturation_is_an_argument():
    gates = torch.tensor([0.01, 0.2, 0.5, 0.85])
    assert gate_diagnostics(gates.unsqueeze(0), saturation=0.02)["saturation"] == 0.25
    assert gate_diagnostics(gates.unsqueeze(0), saturation=0.3)["saturation"] == 0.75


@pytest.mark.parametrize(
    ("goal_dim", "num_primitives", "parameters"),
    [
        # (105+2)*1024+1024 + 1024*512+512 + 512*8+8: 110592 + 524800 + 4104
        pytest.param(2, 8, 639_496, id="heading"),
        # The goal shows two states of the reference: (105+208)*1024+1024 = 321536 in place of 110592
        pytest.param(208, 8, 850_440, id="imitation"),
        # The hierarchical model picks one of seven: 512*7+7 = 3591 in place of 4104
        pytest.param(2, 7, 638_983, id="seven primitives"),
    ],
)
def test_a_joint_gate_has_the_parameters_of_section_e6(goal_dim, num_primitives, parameters):
    gating = JointGating(105, goal_dim, num_primitives)
    assert count(gating) == parameters
    logits = gating(torch.zeros(3, 4, 105), torch.zeros(3, 4, goal_dim))
    assert logits.shape == (3, 4, num_primitives)


def test_a_joint_gate_is_one_network_over_state_and_goal():
    gating = JointGating(3, 2, 4, num_cells=(8, 6))
    observation, goal = torch.randn(10, 3), torch.randn(10, 2)
    first, _, second, _ = gating.body
    hidden = second(first(torch.cat([observation, goal], -1)).relu()).relu()
    torch.testing.assert_close(gating(observation, goal), gating.output(hidden))


@pytest.mark.parametrize("gate", [Gating, JointGating])
def test_logits_stay_float32_under_autocast(gate):
    with torch.autocast("cpu", torch.bfloat16):
        assert gate(27, 2, 8)(torch.randn(10, 27), torch.randn(10, 2)).dtype == torch.float32


@pytest.mark.parametrize(
    "network", [Gating(3, 2, 4), JointGating(3, 2, 4), StateGoalEncoder(3, 2, 4), Primitives(3, 2, 4)]
)
@pytest.mark.parametrize(("dtype", "wide"), [(torch.float64, torch.float64), (torch.bfloat16, torch.float32)])
def test_networks_compute_in_their_own_precision_and_return_at_least_single(network, dtype, wide):
    network = copy.deepcopy(network).to(dtype)
    inputs = [torch.ones(3, dtype=dtype), torch.ones(2, dtype=dtype)]
    outputs = network(*inputs[: 1 if isinstance(network, Primitives) else 2])
    last = outputs[-1] if isinstance(outputs, tuple) else outputs
    assert last.dtype == wide
