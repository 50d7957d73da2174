"""The multiplicative composition of Gaussian primitives (Eq. 3), and the checks it shares with the additive one."""

import math
from functools import reduce
from typing import Self

import torch
from torch import Size, Tensor
from torch.distributions import Distribution, Independent, Normal

# The composite standard deviation when no primitive acts. It is far above any useful action scale (a primitive of
# scale 1e3 still reaches it only below a gate of 0.01), and low enough that 6-sigma samples stay finite in float16
# and their squares, divided by the smallest sensible variance, in float32.
MAX_SCALE = 1e4
LOG_PRECISION_FLOOR = -2 * math.log(MAX_SCALE)


class MultiplicativeGaussian(Independent):
    r"""Weighted product of :math:`K` diagonal Gaussians, renormalised: itself a diagonal Gaussian.

    .. math::
        \pi(a) = \frac{1}{Z} \prod_{k=1}^K \mathcal{N}(a; \mu_k, \sigma_k^2)^{w_k}
        = \mathcal{N}(a; \mu, \sigma^2), \qquad
        \frac{1}{\sigma^2} = \sum_{k=1}^K \frac{w_k}{\sigma_k^2}, \qquad
        \mu = \sigma^2 \sum_{k=1}^K \frac{w_k}{\sigma_k^2} \mu_k

    Sampling, densities, entropy and Kullback-Leibler divergences come from :class:`torch.distributions.Independent`.

    The precision :math:`1 / \sigma^2` is at least ``1e-8`` (a standard deviation of ``1e4``): below that, a zero-mean
    Gaussian makes up the difference. With all gates closed the composite is :math:`\mathcal{N}(0, 10^8)` instead of a
    division by zero. Values and gradients are finite there as well.

    Arguments of half precision are promoted to ``float32``, and so are the samples: a ``bfloat16`` log-density over
    tens of actions is off by more than the clip range of a policy ratio.

    Args:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, shape ``(*B, K, A)``, positive; the paper writes its
            variance as :math:`\sigma`, without the square.
        gates: Weights, shape ``(*B, K)``, non-negative; they need not sum to one.
        validate_args: Whether to check the arguments; ``None`` follows torch's default, which importing TorchRL
            switches off.

    Raises:
        ValueError: If validation is on and the shapes do not broadcast, ``loc`` is not finite, ``scale`` is not
            positive and finite, or ``gates`` are negative or not finite.

    Reference:
        Peng et al., "MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies",
        NeurIPS 2019, https://arxiv.org/abs/1905.09808, Eq. 3.

    Example:
        >>> loc, scale = torch.tensor([[0.0], [3.0]]), torch.tensor([[1.0], [2.0]])
        >>> policy = MultiplicativeGaussian(loc, scale, gates=torch.tensor([0.5, 2.0]))
        >>> policy.mean, policy.variance
        (tensor([1.5000]), tensor([1.]))
    """

    def __init__(self, loc: Tensor, scale: Tensor, gates: Tensor, validate_args: bool | None = None) -> None:
        loc, scale, gates = broadcast_primitives(loc, scale, gates, validate_args)
        gates = gates.unsqueeze(-1)
        log_precision = -2 * scale.log()
        # log sum_k w_k exp(x_k) around an anchor that cancels: unlike logsumexp(log w + x), it has a gradient at w = 0.
        anchor = (gates.log() + log_precision).amax(-2, keepdim=True).clamp_min(LOG_PRECISION_FLOOR).detach()
        # An exponent above 80 belongs to a closed gate, and would make its weight 0 * inf.
        weights = gates * (log_precision - anchor).clamp_max(80.0).exp()
        total = weights.sum(-2, keepdim=True).clamp_min((LOG_PRECISION_FLOOR - anchor).exp())
        mean = (weights / total * loc).sum(-2)
        stddev = (-(anchor + total.log()) / 2).exp().squeeze(-2)
        super().__init__(Normal(mean, stddev, validate_args), 1, validate_args)

    def expand(self, batch_shape: Size | list[int] | tuple[int, ...], _instance: Distribution | None = None) -> Self:
        """Return the same distribution over a larger batch, without copying."""
        return super().expand(batch_shape, self._get_checked_instance(MultiplicativeGaussian, _instance))

    @property
    def deterministic_sample(self) -> Tensor:
        """The mean, shape ``(*B, A)``, which TorchRL plays when exploration is off."""
        return self.mean


def broadcast_primitives(
    loc: Tensor, scale: Tensor, gates: Tensor, validate_args: bool | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Bring primitives and gates to one floating-point type and batch shape, after checking them if asked to.

    Args:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, shape ``(*B, K, A)``.
        gates: Weights, shape ``(*B, K)``.
        validate_args: Whether to check; ``None`` follows torch's default.

    Returns:
        ``loc``, ``scale`` and ``gates`` in the widest of their types, ``float32`` at least.

    Raises:
        ValueError: If validation is on and an argument is malformed.
    """
    if Distribution._validate_args if validate_args is None else validate_args:
        check_primitives(loc, scale, gates)
    dtype = reduce(torch.promote_types, (loc.dtype, scale.dtype, gates.dtype), torch.float32)
    shape = torch.broadcast_shapes(loc.shape, scale.shape, (*gates.shape, 1))
    return loc.to(dtype).expand(shape), scale.to(dtype).expand(shape), gates.to(dtype).expand(shape[:-1])


def check_primitives(loc: Tensor, scale: Tensor, gates: Tensor) -> None:
    """Check that primitives and gates make a distribution.

    Args:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, shape ``(*B, K, A)``.
        gates: Weights, shape ``(*B, K)``.

    Raises:
        ValueError: If not, with the argument, its value or shape, and the remedy.
    """
    shapes = f"loc {tuple(loc.shape)}, scale {tuple(scale.shape)} and gates {tuple(gates.shape)}"
    remedy = "pass loc and scale of shape (*B, K, A) and gates of shape (*B, K)"
    if loc.ndim < 2 or gates.ndim < 1:
        raise ValueError(f"{shapes} lack a dimension for the primitives: {remedy}.")
    try:
        torch.broadcast_shapes(loc.shape, scale.shape, (*gates.shape, 1))
    except RuntimeError as error:
        raise ValueError(f"{shapes} do not broadcast: {remedy}.") from error
    for name, value, valid, rule in (
        ("loc", loc, loc.isfinite(), "finite; look for a diverged network or an unnormalised observation"),
        ("scale", scale, scale.isfinite() & (scale > 0), "positive and finite; pass it through an exp or a softplus"),
        ("gates", gates, gates.isfinite() & (gates >= 0), "non-negative and finite; end the gate in a sigmoid"),
    ):
        if not torch._is_all_true(valid):  # as in torch.distributions: all() fails under vmap
            raise ValueError(f"{name} of shape {tuple(value.shape)} holds {value[~valid][0].item()}, must be {rule}.")
