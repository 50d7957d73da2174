"""Value functions as TensorDictModules."""

from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.modules import MLP, ValueOperator

from torchrl_mcp.methods.actor import GOAL, STATE, Sizes, normalise_inputs
from torchrl_mcp.modules.gating import scaled_cells
from torchrl_mcp.values import Positive, Widths


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
    parts["critic"] = MLP(
        in_features=sizes.observation + sizes.goal,
        out_features=1,
        num_cells=scaled_cells(num_cells, width),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},  # the same numbers without a second copy of every hidden layer
    )
    return TensorDictSequential(normalise_inputs(parts), ValueOperator(parts["critic"], in_keys=[STATE, GOAL]))
