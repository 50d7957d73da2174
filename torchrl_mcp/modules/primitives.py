"""K Gaussian primitives that see the state but not the goal."""

import math
from collections.abc import Sequence

import torch
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn

from torchrl_mcp.modules.gating import at_least_single, relu_mlp, scaled_cells
from torchrl_mcp.values import Count, NotNegative, Positive, Whole, Widths, checked


class Primitives(nn.Module):
    r"""K Gaussian primitives :math:`\pi_k(a|s) = \mathcal{N}(\mu_k(s), \Sigma_k(s))` on one shared trunk.

    After the trunk, each primitive has one hidden layer and one linear output layer of its own, as in Figure 3. With
    ``branch_cells=0``, each primitive has a linear layer only, as in the mixture of experts. The layers of all
    primitives are evaluated together, as batched matrix products.

    Args:
        observation_dim: Size of the state, ``S``.
        action_dim: Size of the action, ``A``.
        num_primitives: Number of primitives, ``K``.
        trunk_cells: Hidden units shared by all primitives.
        branch_cells: Hidden units of each primitive's own layer; 0 for none.
        width: Factor on all numbers of hidden units.
        initial_std: Standard deviation of every primitive before training, in action units.
        output_gain: Factor on the initial weights of the output layers; small values start all primitives alike.
        std_gain: Factor on the output layer for :math:`\log \sigma`. Adam moves every weight by about its step size.
            With a factor of 1, :math:`\log \sigma` therefore changes many times as fast as if it were a parameter;
            smaller factors slow this down.

    Raises:
        ValueError: If ``num_primitives``, ``initial_std`` or ``std_gain`` is not positive.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Figure 3, Eq. 4 and Section E.6. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import Primitives
        >>> primitives = Primitives(observation_dim=105, action_dim=17, num_primitives=8)
        >>> loc, scale = primitives(torch.randn(16, 105))
        >>> loc.shape, scale.shape
        (torch.Size([16, 8, 17]), torch.Size([16, 8, 17]))
    """

    @checked
    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        num_primitives: Count,
        *,
        trunk_cells: Widths = (512, 256),
        branch_cells: Whole = 256,
        width: Positive = 1.0,
        initial_std: Positive = 1.0,
        output_gain: NotNegative = 1.0,
        std_gain: Positive = 1.0,
    ) -> None:
        super().__init__()
        trunk_cells = scaled_cells(trunk_cells, width)
        branch_cells = scaled_cells([branch_cells], width)[0] if branch_cells else 0
        self.trunk = relu_mlp(observation_dim, trunk_cells)
        self.branches = BatchedLinear(num_primitives, trunk_cells[-1], branch_cells) if branch_cells else None
        self.rectifier = nn.ReLU() if branch_cells else nn.Identity()
        self.output = BatchedLinear(num_primitives, branch_cells or trunk_cells[-1], 2 * action_dim)
        self.std_gain = std_gain
        with torch.no_grad():
            self.output.weight.mul_(output_gain)
            self.output.bias.zero_()
            self.output.bias[:, action_dim:] = math.log(initial_std) / std_gain

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and standard deviations, each ``(*B, K, A)``, from a state ``(*B, S)``."""
        features = self.trunk(observation).unsqueeze(-2)
        if self.branches is not None:
            features = self.rectifier(self.branches(features))
        loc, log_scale = self.output(features).chunk(2, dim=-1)
        return loc, (self.std_gain * at_least_single(log_scale)).exp()

    @staticmethod
    def from_policies(policies: Sequence[nn.Module]) -> "PolicyPrimitives":
        """Make primitives from trained policies, see :class:`PolicyPrimitives`."""
        return PolicyPrimitives(policies)

    @torch.no_grad()
    def rescale(self, factor: float) -> None:
        """Multiply all means and standard deviations by ``factor``, positive."""
        action_dim = self.output.bias.shape[-1] // 2
        self.output.weight[..., :action_dim] *= factor
        self.output.bias[:, :action_dim] *= factor
        self.output.bias[:, action_dim:] += math.log(factor) / self.std_gain


class PolicyPrimitives(nn.Module):
    r"""K Gaussian policies :math:`\pi_k(a|s) = \mathcal{N}(\mu_k(s), \Sigma_k(s))` as primitives, of any networks.

    Args:
        policies: Modules that return mean and standard deviation, ``(*B, A)``, for a state ``(*B, S)``; or actors of
            TorchRL with one input, whose distribution takes a mean and a standard deviation. A standard deviation with
            fewer dimensions is expanded.

    Raises:
        ValueError: If there are no policies.

    Example:
        >>> import torch
        >>> from torch import nn
        >>> from torchrl_mcp.modules import Primitives
        >>> class Walk(nn.Module):
        ...     def forward(self, state):
        ...         return state[..., :2], torch.tensor(0.1)
        >>> loc, scale = Primitives.from_policies([Walk(), Walk(), Walk()])(torch.zeros(5, 4))
        >>> loc.shape, scale.shape
        (torch.Size([5, 3, 2]), torch.Size([5, 3, 2]))
    """

    def __init__(self, policies: Sequence[nn.Module]) -> None:
        super().__init__()
        if not policies:
            raise ValueError("policies is empty: pass at least one policy")
        self.policies = nn.ModuleList(_before_sampling(policy) for policy in policies)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and standard deviations, each ``(*B, K, A)``, from a state ``(*B, S)``.

        Raises:
            ValueError: If a policy returns something else, or policies have different numbers of actions.
        """
        outputs = [policy(observation) for policy in self.policies]
        if wrong := [k for k, output in enumerate(outputs) if not isinstance(output, tuple) or len(output) != 2]:
            raise ValueError(f"policy {wrong[0]} must return mean and standard deviation, a tuple of two tensors")
        means = [loc for loc, _ in outputs]
        if wrong := [k for k, loc in enumerate(means) if loc.shape != means[0].shape]:
            shapes = tuple(means[wrong[0]].shape), tuple(means[0].shape)
            raise ValueError(f"policy {wrong[0]} returns means of shape {shapes[0]}, must be {shapes[1]} as policy 0's")
        return torch.stack(means, -2), torch.stack([scale.expand_as(loc) for loc, scale in outputs], -2)


def _before_sampling(policy: nn.Module) -> nn.Module:
    """Return the part of a TorchRL actor that makes the parameters of its distribution; other policies as they are."""
    if not isinstance(policy, ProbabilisticTensorDictSequential):
        return policy
    return policy.det_part.select_out_keys(*policy.dist_params_keys)


class BatchedLinear(nn.Module):
    """K linear layers side by side, from ``(*B, K, I)``, or ``(*B, 1, I)`` for all layers, to ``(*B, K, O)``.

    Args:
        num_layers: Number of layers, ``K``.
        in_features: Input size, ``I``.
        out_features: Output size, ``O``.
    """

    def __init__(self, num_layers: int, in_features: int, out_features: int) -> None:
        super().__init__()
        # nn.Linear's own initialisation, layer by layer.
        layers = [nn.Linear(in_features, out_features) for _ in range(num_layers)]
        self.weight = nn.Parameter(torch.stack([layer.weight.detach().T for layer in layers]))
        self.bias = nn.Parameter(torch.stack([layer.bias.detach() for layer in layers]))

    def forward(self, x: Tensor) -> Tensor:
        """Apply layer k to ``x[..., k, :]``."""
        return (
            torch.einsum("...ki,kio->...ko", x.expand(*x.shape[:-2], *self.bias.shape[:1], -1), self.weight) + self.bias
        )
