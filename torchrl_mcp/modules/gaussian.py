"""The policy network of the scratch model."""

import math

import torch
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, nn

from torchrl_mcp.modules.gating import relu_mlp, scaled_cells, scaled_linear
from torchrl_mcp.values import NotNegative, Positive, Positives, Widths

LEAST_STD = 1e-4
"""Smallest standard deviation of a policy whose noise is the same in all states, at which it is clamped."""


class GaussianPolicy(nn.Module):
    r"""A network for the mean of an action: :math:`\mathcal{N}(\mu(s, g), \mathrm{diag}(\sigma^2))`.

    The standard deviation is the same in all states. The paper fixes it. A learned standard deviation can shrink when
    noise limits the reward.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        action_dim: Size of the action, ``A``.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.
        std: Standard deviation, one for all actions or one each, in action units.
        learned_std: Whether to learn the standard deviation, starting at ``std``, or to fix it.
        output_gain: Factor on the initial weights of the output layer.

    Raises:
        ValueError: If ``std`` is below ``1e-4`` or is neither one number nor one per action.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Section E.2. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> policy = GaussianPolicy(observation_dim=105, goal_dim=2, action_dim=17, std=0.1)
        >>> loc, scale = policy(torch.randn(16, 105), torch.randn(16, 2))
        >>> loc.shape, scale.shape, scale[0, 0].item()
        (torch.Size([16, 17]), torch.Size([16, 17]), 0.1)
    """

    def __init__(
        self,
        observation_dim: int,
        goal_dim: int,
        action_dim: int,
        *,
        num_cells: Widths = (1024, 512),
        width: Positive = 1.0,
        std: Positive | Positives = 0.1,
        learned_std: bool = False,
        output_gain: NotNegative = 0.01,
    ) -> None:
        super().__init__()
        num_cells = scaled_cells(num_cells, width)
        self.body = relu_mlp(observation_dim + goal_dim, num_cells)
        self.output = scaled_linear(num_cells[-1], action_dim, output_gain)
        self.scale = state_independent_scale(std, action_dim, learned_std)

    def forward(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, each ``(*B, A)``, from a state ``(*B, S)`` and a goal ``(*B, G)``."""
        return self.scale(self.output(self.body(observation, goal)))


@torch.no_grad()
def restart_noise(network: nn.Module, std: Positive) -> None:
    """Set the standard deviations of all policies in a network whose noise is the same in all states.

    Args:
        network: The network; other modules in it stay as they are.
        std: Standard deviation of all actions, in action units.

    Raises:
        ValueError: If ``std`` is below ``1e-4``.
    """
    if not std >= LEAST_STD:
        raise ValueError(f"std must be at least {LEAST_STD:g}, got {std}")
    for module in network.modules():
        if isinstance(module, AddStateIndependentNormalScale):
            module.state_independent_scale.fill_(math.log(std))


def state_independent_scale(
    std: Positive | Positives, action_dim: int, learned: bool
) -> AddStateIndependentNormalScale:
    """Return the module that adds standard deviations, one for all actions or one each, to means ``(*B, A)``.

    Raises:
        ValueError: If ``std`` is below ``1e-4`` or is neither one number nor one per action.
    """
    scale = torch.as_tensor(std, dtype=torch.float32)
    if scale.numel() not in (1, action_dim) or not (scale >= LEAST_STD).all():
        raise ValueError(f"std must be one number of at least {LEAST_STD:g} or {action_dim}, one per action, got {std}")
    module = AddStateIndependentNormalScale(action_dim, scale_lb=LEAST_STD, make_param=learned)
    with torch.no_grad():
        module.state_independent_scale.copy_(scale.log())
    return module
