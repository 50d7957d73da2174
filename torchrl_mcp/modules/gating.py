"""Gating networks, and diagnostics of their weights."""

import warnings

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_mcp.values import Count, NotNegative, Positive, Whole, Widths, checked


class Gating(nn.Module):
    r"""Gate logits from state and goal: the left half of Figure 3, up to the output activation.

    Two networks encode state and goal separately. Their features are concatenated and pass through one more layer.
    The activation that turns logits into weights, a sigmoid in the paper, is not part of this module, because
    exploration over weights samples the logits.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        num_primitives: Number of logits, ``K``.
        state_cells: Hidden units of the state encoder.
        goal_cells: Hidden units of the goal encoder.
        joint_cells: Hidden units after the concatenation.
        width: Factor on all numbers of hidden units.
        output_gain: Factor on the initial weights of the output layer; small values start all gates alike.

    Reference:
        Peng et al., *MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies*,
        NeurIPS 2019, Figure 3. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import Gating
        >>> gating = Gating(observation_dim=105, goal_dim=2, num_primitives=8)
        >>> gates = gating(torch.randn(16, 105), torch.randn(16, 2)).sigmoid()
        >>> gates.shape
        torch.Size([16, 8])
    """

    @checked
    def __init__(
        self,
        observation_dim: Whole,
        goal_dim: Whole,
        num_primitives: Count,
        *,
        state_cells: Widths = (512, 256),
        goal_cells: Widths = (512, 256),
        joint_cells: Widths = (256,),
        width: Positive = 1.0,
        output_gain: NotNegative = 1.0,
    ) -> None:
        super().__init__()
        state_cells = scaled_cells(state_cells, width)
        goal_cells = scaled_cells(goal_cells, width)
        joint_cells = scaled_cells(joint_cells, width)
        self.state_encoder = relu_mlp(observation_dim, state_cells)
        self.goal_encoder = relu_mlp(goal_dim, goal_cells)
        self.joint = relu_mlp(state_cells[-1] + goal_cells[-1], joint_cells)
        self.output = scaled_linear(joint_cells[-1], num_primitives, output_gain)

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return logits ``(*B, K)`` from a state ``(*B, S)`` and a goal ``(*B, G)``."""
        features = torch.cat([self.state_encoder(observation), self.goal_encoder(goal)], dim=-1)
        return at_least_single(self.output(self.joint(features)))


class JointGating(nn.Module):
    r"""Gate logits from one network over state and goal, without separate encoders.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        num_primitives: Number of logits, ``K``.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.
        output_gain: Factor on the initial weights of the output layer; small values start all gates alike.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Sections E.4 and E.6. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import JointGating
        >>> gating = JointGating(observation_dim=105, goal_dim=2, num_primitives=8)
        >>> gates = gating(torch.randn(16, 105), torch.randn(16, 2)).softmax(-1)
        >>> gates.sum(-1).allclose(torch.ones(16))
        True
    """

    @checked
    def __init__(
        self,
        observation_dim: Whole,
        goal_dim: Whole,
        num_primitives: Count,
        *,
        num_cells: Widths = (1024, 512),
        width: Positive = 1.0,
        output_gain: NotNegative = 1.0,
    ) -> None:
        super().__init__()
        num_cells = scaled_cells(num_cells, width)
        self.body = relu_mlp(observation_dim + goal_dim, num_cells)
        self.output = scaled_linear(num_cells[-1], num_primitives, output_gain)

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return logits ``(*B, K)`` from a state ``(*B, S)`` and a goal ``(*B, G)``."""
        return at_least_single(self.output(self.body(observation, goal)))


@checked
def scaled_cells(num_cells: Widths, width: Positive) -> list[int]:
    """Return numbers of hidden units times ``width``, rounded.

    Raises:
        ValueError: If ``num_cells`` is not a list of layers, or a layer would have no units.
    """
    scaled = [round(cells * width) for cells in num_cells]
    if min(scaled) < 1:
        raise ValueError(f"width={width} leaves no units in a layer of {min(num_cells)}: pass a larger one")
    return scaled


def relu_mlp(in_features: int, num_cells: Widths) -> MLP:
    """Return fully connected layers, each followed by a ReLU (Figure 3).

    Without inputs, as for the goal of a task that has none, the features are constants.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Initializing zero-element tensors")
        return MLP(
            in_features=in_features,
            out_features=num_cells[-1],
            num_cells=list(num_cells[:-1]),
            activation_class=nn.ReLU,
            activate_last_layer=True,
        )


def at_least_single(values: Tensor) -> Tensor:
    """Return values of half precision as ``float32``, and others as they are."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def scaled_linear(in_features: int, out_features: int, gain: float) -> nn.Linear:
    """Return a linear layer whose initial weights are torch's times ``gain`` and whose bias starts at zero."""
    layer = nn.Linear(in_features, out_features)
    with torch.no_grad():
        layer.weight.mul_(gain)
        layer.bias.zero_()
    return layer


def gate_diagnostics(gates: Tensor, saturation: float = 0.05) -> dict[str, Tensor]:
    r"""Summarise gates as scalars: whether primitives share the work, and whether gates are saturated.

    - ``sum`` is the mean of :math:`\sum_k w_k`, which divides the composite variance.
    - ``saturation`` is the share of gates near 0 or 1, where a sigmoid hardly learns.
    - ``entropy`` is the mean entropy of the normalised weights, in nats.
    - ``effective_primitives`` is the mean of its exponential: K for equal gates, 1 if only one gate is open.
    - ``usage_k`` is the mean weight of primitive k, counted from 0.

    Args:
        gates: Weights, shape ``(*B, K)``.
        saturation: Distance from 0 or 1 within which a gate counts as saturated.

    Returns:
        The diagnostics by name, each a scalar.

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import gate_diagnostics
        >>> report = gate_diagnostics(torch.tensor([[1.0, 0.0], [0.5, 0.5]]))
        >>> report["effective_primitives"], report["saturation"], report["usage_0"]
        (tensor(1.5000), tensor(0.5000), tensor(0.7500))
    """
    gates = gates.detach().float().reshape(-1, gates.shape[-1])
    share = gates / gates.sum(-1, keepdim=True).clamp_min(torch.finfo(gates.dtype).tiny)
    entropy = torch.special.entr(share).sum(-1)
    diagnostics = {
        "sum": gates.sum(-1).mean(),
        "saturation": ((gates < saturation) | (gates > 1 - saturation)).float().mean(),
        "entropy": entropy.mean(),
        "effective_primitives": entropy.exp().mean(),
    }
    return diagnostics | {f"usage_{k}": usage for k, usage in enumerate(gates.mean(0))}
