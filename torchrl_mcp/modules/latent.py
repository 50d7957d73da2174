"""Encoders of the latent space model: from goals to distributions of a latent variable."""

from torch import Tensor, nn

from torchrl_mcp.modules.gating import at_least_single, relu_mlp, scaled_cells
from torchrl_mcp.values import Count, NotNegative, Positive, Whole, Widths, checked


class StateGoalEncoder(nn.Module):
    r"""The encoder of a transfer task, :math:`q(w|s, g) = \mathcal{N}(\mu_q(s, g), \mathrm{diag}(\sigma_q^2(s, g)))`.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        latent_dim: Size of the latent variable, ``L``.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.
        min_std: Lower bound of the standard deviation. Without a bound, the standard deviation can become tiny in
            states that are far from most others, for example while the character falls. There, even a small change of
            the mean is then an enormous KL divergence.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Section E.7. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import StateGoalEncoder
        >>> encoder = StateGoalEncoder(observation_dim=105, goal_dim=2, latent_dim=16)
        >>> loc, scale = encoder(torch.randn(32, 105), torch.randn(32, 2))
        >>> loc.shape, scale.shape
        (torch.Size([32, 16]), torch.Size([32, 16]))
    """

    @checked
    def __init__(
        self,
        observation_dim: Whole,
        goal_dim: Whole,
        latent_dim: Count,
        *,
        num_cells: Widths = (1024, 512),
        width: Positive = 1.0,
        min_std: NotNegative = 0.0,
    ) -> None:
        super().__init__()
        self.min_std = min_std
        num_cells = scaled_cells(num_cells, width)
        self.body = relu_mlp(observation_dim + goal_dim, num_cells)
        self.output = nn.Linear(num_cells[-1], 2 * latent_dim)

    def forward(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, each ``(*B, L)``, from a state ``(*B, S)`` and a goal ``(*B, G)``."""
        return self._gaussian(observation, goal)

    def _gaussian(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_scale = at_least_single(self.output(self.body(*inputs))).chunk(2, dim=-1)
        return loc, log_scale.exp().clamp_min(self.min_std)


class GoalEncoder(StateGoalEncoder):
    r"""The encoder of pre-training, :math:`q(w|g)`, which does not see the state.

    The arguments are those of :class:`StateGoalEncoder`, so that one can replace the other.

    Args:
        observation_dim: Size of the state, ``S``; not used.
        goal_dim: Size of the goal, ``G``.
        latent_dim: Size of the latent variable, ``L``.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.
        min_std: Lower bound of the standard deviation.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Section E.7. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import GoalEncoder
        >>> encoder = GoalEncoder(observation_dim=105, goal_dim=210, latent_dim=16)
        >>> loc, scale = encoder(torch.randn(32, 105), torch.randn(32, 210))
        >>> loc.shape, scale.shape
        (torch.Size([32, 16]), torch.Size([32, 16]))
    """

    @checked
    def __init__(
        self,
        observation_dim: Whole,
        goal_dim: Whole,
        latent_dim: Count,
        *,
        num_cells: Widths = (256, 128),
        width: Positive = 1.0,
        min_std: NotNegative = 0.0,
    ) -> None:
        super().__init__(0, goal_dim, latent_dim, num_cells=num_cells, width=width, min_std=min_std)

    def forward(self, observation: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, each ``(*B, L)``, from a goal ``(*B, G)`` alone."""
        return self._gaussian(goal)
