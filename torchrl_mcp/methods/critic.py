"""Value functions as TensorDictModules."""

import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, ValueOperator

from torchrl_mcp.methods.actor import GOAL, STATE, Sizes, normalise_inputs
from torchrl_mcp.modules.gating import scaled_cells
from torchrl_mcp.values import Count, Positive, Widths


def value_critic(
    parts: nn.ModuleDict, sizes: Sizes, *, num_cells: Widths = (1024, 512), width: Positive = 1.0
) -> TensorDictSequential:
    """Add the part ``critic``, V(s, g), and return it as a module from ``observation`` and ``goal`` to ``state_value``.

    Args:
        parts: Parts of the actor, to which the critic is added. The critic shares the normalisers.
        sizes: Sizes of state, goal and action.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.

    Returns:
        The module. ``state_value`` has the shape ``(*B, 1)``.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Section E.1. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.methods.actor import Sizes, input_normalisers
        >>> from torchrl_mcp.methods.critic import value_critic
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> critic = value_critic(torch.nn.ModuleDict(input_normalisers(sizes)), sizes)
        >>> states = TensorDict({"observation": torch.randn(16, 105), "goal": torch.randn(16, 2)}, [16])
        >>> critic(states)["state_value"].shape
        torch.Size([16, 1])
    """
    parts["critic"] = value_network(sizes, 1, num_cells=num_cells, width=width)
    return TensorDictSequential(normalise_inputs(parts), ValueOperator(parts["critic"], in_keys=[STATE, GOAL]))


def value_network(sizes: Sizes, num_values: Count, *, num_cells: Widths, width: Positive) -> MLP:
    """Return a network from state ``(*B, S)`` and goal ``(*B, G)`` to values ``(*B, num_values)``.

    Args:
        sizes: Sizes of state, goal and action.
        num_values: Number of values: 1, or one for each option.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.
    """
    cells = scaled_cells(num_cells, width)
    network = MLP(
        in_features=sizes.observation + sizes.goal,
        out_features=cells[-1],
        num_cells=cells[:-1],
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},  # the same numbers without a second copy of every hidden layer
        activate_last_layer=True,
    )
    network.append(FullPrecisionLinear(cells[-1], num_values))
    return network


class FullPrecisionLinear(nn.Linear):
    """A linear layer that computes in the precision of its weights, also under autocast.

    Advantages are differences between values of similar size. The rounding of a value to ``bfloat16``, by up to 0.4 %,
    would be large in comparison.

    Example:
        >>> import torch
        >>> from torchrl_mcp.methods.critic import FullPrecisionLinear
        >>> with torch.autocast("cpu", torch.bfloat16):
        ...     FullPrecisionLinear(3, 1)(torch.randn(16, 3)).dtype
        torch.float32
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return ``(*B, O)`` from ``(*B, I)``."""
        if not torch.is_autocast_enabled(x.device.type):
            return super().forward(x)
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))
