"""The multiplicative composition of Gaussian primitives (Eq. 3)."""

from typing import Self

import torch
from torch import Size, Tensor
from torch.distributions import Distribution, Independent, Normal

from torchrl_mcp.distributions.primitives import GatedPrimitives, broadcast_primitives

# The composite standard deviation when no primitive acts. It is far above any useful action scale (a primitive of
# scale 1e3 still reaches it only below a gate of 0.01), and low enough that 6-sigma samples stay finite in float16
# and their squares, divided by the smallest sensible variance, in float32.
MAX_SCALE = 1e4

# The standard deviation as which that of a narrower primitive counts. It is far below the rounding of any action, and
# its precision is finite in float32: a closed gate must remove a narrow primitive, and 0 * inf is NaN.
MIN_SCALE = 1e-12


class MultiplicativeGaussian(GatedPrimitives, Independent):
    r"""Weighted product of :math:`K` diagonal Gaussians, renormalised: itself a diagonal Gaussian.

    .. math::
        \pi(a) = \frac{1}{Z} \prod_{k=1}^K \mathcal{N}(a; \mu_k, \sigma_k^2)^{w_k}
        = \mathcal{N}(a; \mu, \sigma^2), \qquad
        \frac{1}{\sigma^2} = \sum_{k=1}^K \frac{w_k}{\sigma_k^2}, \qquad
        \mu = \sigma^2 \sum_{k=1}^K \frac{w_k}{\sigma_k^2} \mu_k

    The mean, the samples and the standard deviation have the shape ``(*B, A)`` and the unit of the actions.
    Log-densities and entropies have the shape ``(*B,)`` and are in nats. Sampling, densities, entropy and
    Kullback-Leibler divergences come from :class:`torch.distributions.Independent`.

    The precision :math:`1 / \sigma^2` is at least ``1e-8``, which is a standard deviation of ``1e4``. If the primitives
    result in less, a zero-mean Gaussian makes up the difference. If all gates are zero, the composite is therefore
    :math:`\mathcal{N}(0, 10^8)` instead of a division by zero, and values and gradients remain finite. A primitive's
    standard deviation below ``1e-12`` counts as ``1e-12``.

    Arguments of half precision are promoted to ``float32``, and samples are ``float32``, because a ``bfloat16``
    log-density over tens of actions is wrong by more than the clip range of a policy ratio.

    Args:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, a number or shape ``(*B, K, A)``, positive. (The paper's :math:`\sigma`
            is the variance.)
        gates: Weights, shape ``(*B, K)``, non-negative. They need not sum to one.
        validate_args: Whether to check values. ``None`` follows torch's default, which is off once
            ``torchrl.modules``, and therefore ``torchrl_mcp.modules``, is imported. Shapes are always checked. Unless
            it is ``False``, the signs of scales and gates are also checked, on a CPU and outside ``torch.compile``.

    Raises:
        ValueError: If the shapes do not match. With validation also if ``loc`` is not finite, ``scale`` is not
            positive and finite, or ``gates`` are negative or not finite.

    Reference:
        Peng et al., "MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies",
        NeurIPS 2019, https://arxiv.org/abs/1905.09808, Eq. 3.

    Example:
        >>> import torch
        >>> from torchrl_mcp.distributions import MultiplicativeGaussian
        >>> loc, scale = torch.tensor([[0.0], [3.0]]), torch.tensor([[1.0], [2.0]])  # two primitives, one action
        >>> policy = MultiplicativeGaussian(loc, scale, gates=torch.tensor([0.5, 2.0]))
        >>> policy.mean, policy.variance
        (tensor([1.5000]), tensor([1.]))

        A batch of 16 states, with eight primitives and three actions:

        >>> policy = MultiplicativeGaussian(torch.randn(16, 8, 3), torch.ones(16, 8, 3), torch.rand(16, 8))
        >>> action = policy.rsample()
        >>> action.shape, policy.log_prob(action).shape
        (torch.Size([16, 3]), torch.Size([16]))
    """

    def __init__(self, loc: Tensor, scale: Tensor | float, gates: Tensor, validate_args: bool | None = None) -> None:
        loc, scale, gates = broadcast_primitives(loc, scale, gates, validate_args)
        self.loc, self.scale, self.gates = loc, scale, gates
        # Not gates / scale**2, whose gradient overflows already at scales of 1e-10.
        precisions = gates.unsqueeze(-1) * scale.clamp_min(MIN_SCALE).reciprocal().square()
        total = precisions.sum(-2)
        # Where signs are not checked, such as on a GPU, a negative precision must not become a plausible distribution.
        precision = torch.where(total < 0, torch.nan, total.clamp_min(MAX_SCALE**-2))
        mean = (precisions * loc).sum(-2) / precision
        super().__init__(Normal(mean, precision.rsqrt(), validate_args), 1, validate_args)

    def expand(self, batch_shape: Size | list[int] | tuple[int, ...], _instance: Distribution | None = None) -> Self:
        """Return the same distribution over a larger batch, without copying."""
        new = super().expand(batch_shape, self._get_checked_instance(MultiplicativeGaussian, _instance))
        new._expand_primitives(self)
        return new

    @property
    def deterministic_sample(self) -> Tensor:
        """The mean, shape ``(*B, A)``, which TorchRL plays when exploration is off."""
        return self.mean
