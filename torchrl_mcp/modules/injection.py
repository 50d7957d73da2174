"""A policy network that gets new inputs without a change of its output."""

from torch import Tensor, nn

from torchrl_mcp.modules.gating import relu_mlp, scaled_cells, scaled_linear
from torchrl_mcp.modules.gaussian import state_independent_scale
from torchrl_mcp.values import NotNegative, Positive, Positives, Widths


class InputInjection(nn.Linear):
    """Weights ``(H, G)`` from G new inputs to H hidden units, which start at zero.

    Because of the zeros, a network has the same output before and after it gets the new inputs.

    Args:
        in_features: Number of new inputs, ``G``; 0 for a task without a goal.
        out_features: Number of hidden units, ``H``.

    Reference:
        Berseth et al., *Progressive Reinforcement Learning with Distillation for Multi-Skilled Motion Control*,
        ICLR 2018. https://arxiv.org/abs/1802.04765

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import InputInjection
        >>> injection = InputInjection(in_features=2, out_features=512)
        >>> injection(torch.randn(16, 2)).abs().max()
        tensor(0., grad_fn=<MaxBackward1>)
    """

    def __init__(self, in_features: int, out_features: int) -> None:
        super().__init__(in_features, out_features, bias=False)
        nn.init.zeros_(self.weight)

    def reset_parameters(self) -> None:
        """Draw weights as :class:`torch.nn.Linear` does, unless there are none, of which torch would warn."""
        if self.in_features:
            super().reset_parameters()


class InjectedPolicy(nn.Module):
    r"""The network of the scratch model, with separate first-layer weights for state and goal.

    .. math:: \mu = W_3 \operatorname{relu}(W_2 \operatorname{relu}(W_1 s + b_1 + j) + b_2) + b_3

    The injection :math:`j = J g` comes from :class:`InputInjection`. The goal is added rather than concatenated,
    because a matrix product over more columns rounds differently, even if the columns are zero.

    Args:
        observation_dim: Size of the state, ``S``.
        action_dim: Size of the action, ``A``.
        num_cells: Hidden units, two layers or more.
        width: Factor on all numbers of hidden units.
        std: Standard deviation, one for all actions or one each, in action units.
        learned_std: Whether to learn the standard deviation, starting at ``std``, or to fix it.
        output_gain: Factor on the initial weights of the output layer.

    Raises:
        ValueError: If ``std`` is below ``1e-4`` or is neither one number nor one per action, or layers are missing.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Section E.3. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import InjectedPolicy, InputInjection
        >>> policy = InjectedPolicy(observation_dim=105, action_dim=17, num_cells=(1024, 512))
        >>> injection = InputInjection(in_features=2, out_features=1024)  # from the goal to the first layer
        >>> loc, scale = policy(torch.randn(16, 105), injection(torch.randn(16, 2)))
        >>> loc.shape, scale.shape
        (torch.Size([16, 17]), torch.Size([16, 17]))
    """

    def __init__(
        self,
        observation_dim: int,
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
        if len(num_cells) < 2:
            raise ValueError(f"num_cells must name two hidden layers or more, got {num_cells}")
        self.input = nn.Linear(observation_dim, num_cells[0])
        self.rectifier = nn.ReLU()
        self.body = relu_mlp(num_cells[0], num_cells[1:])
        self.output = scaled_linear(num_cells[-1], action_dim, output_gain)
        self.scale = state_independent_scale(std, action_dim, learned_std)

    def forward(self, observation: Tensor, injection: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, ``(*B, A)``, from a state ``(*B, S)`` and an injection ``(*B, H)``."""
        return self.scale(self.output(self.body(self.rectifier(self.input(observation) + injection))))
