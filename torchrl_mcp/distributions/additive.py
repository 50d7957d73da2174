"""The additive composition of Gaussian primitives (Eq. 1): a mixture of experts."""

import math
from collections.abc import Callable, Sequence
from typing import NoReturn, Self

import torch
from torch import Size, Tensor
from torch.distributions import Categorical, Distribution, Independent, MixtureSameFamily, Normal, register_kl

from torchrl_mcp.distributions.primitives import GatedPrimitives, broadcast_primitives

# Normalising multiplies the gradient by 1 / sum(w), on top of log-densities that reach 1e17 when narrow primitives meet
# wide ones: the product must stay in float32. The sum of softmax gates or of open sigmoid gates is far above.
GATES_FLOOR = 1e-8


class AdditiveGaussian(GatedPrimitives, MixtureSameFamily):
    r"""Mixture of :math:`K` diagonal Gaussians: a sample draws a primitive first, and then an action from it.

    .. math:: \pi(a) = \sum_{k=1}^K \bar w_k \, \mathcal{N}(a; \mu_k, \sigma_k^2), \qquad
        \bar w_k = \frac{w_k}{\sum_{j=1}^K w_j}

    The mean and the samples have the shape ``(*B, A)`` and the unit of the actions. Log-densities have the shape
    ``(*B,)`` and are in nats. The entropy has no closed form and is estimated.

    The sum of the gates is at least ``1e-8``. If they sum to less, equal gates make up the difference. Without
    validation, gates that are all zero therefore result in an equal mixture instead of a division by zero. Arguments of
    half precision are promoted to ``float32``, and samples are ``float32``.

    Args:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, a number or shape ``(*B, K, A)``, positive. (The paper's :math:`\sigma`
            is the variance.)
        gates: Weights, shape ``(*B, K)``, non-negative and not all zero. They are normalised to sum to one.
        validate_args: Whether to check values. ``None`` follows torch's default, which is off once
            ``torchrl.modules``, and therefore ``torchrl_mcp.modules``, is imported. Shapes are always checked. Unless
            it is ``False``, the signs of scales and gates are also checked, on a CPU and outside ``torch.compile``.

    Raises:
        ValueError: If the shapes do not match. With validation also if ``loc`` is not finite, ``scale`` is not
            positive and finite, or ``gates`` are negative, not finite or all zero.

    Reference:
        Peng et al., "MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies",
        NeurIPS 2019, https://arxiv.org/abs/1905.09808, Eq. 1.

    Example:
        >>> import torch
        >>> from torchrl_mcp.distributions import AdditiveGaussian
        >>> loc, scale = torch.tensor([[0.0], [4.0]]), torch.ones(2, 1)  # two primitives, one action
        >>> policy = AdditiveGaussian(loc, scale, gates=torch.tensor([3.0, 1.0]))
        >>> policy.mean, policy.variance, policy.deterministic_sample
        (tensor([1.]), tensor([4.]), tensor([0.]))
    """

    def __init__(self, loc: Tensor, scale: Tensor | float, gates: Tensor, validate_args: bool | None = None) -> None:
        loc, scale, gates = broadcast_primitives(loc, scale, gates, validate_args)
        self.loc, self.scale, self.gates = loc, scale, gates
        total = gates.sum(-1, keepdim=True)
        gates = gates + (GATES_FLOOR - total).clamp_min(0) / gates.shape[-1]
        super().__init__(
            Categorical(probs=gates, validate_args=validate_args),
            Independent(Normal(loc, scale, validate_args), 1, validate_args),
            validate_args,
        )
        if self._validate_args and not torch._is_all_true(total > 0):
            raise ValueError(
                f"gates of shape {tuple(gates.shape)} have a row of zeros, but at least one gate must be positive: "
                "end the gate in a softmax."
            )

    def expand(self, batch_shape: Size | list[int] | tuple[int, ...], _instance: Distribution | None = None) -> Self:
        """Return the same distribution over a larger batch, without copying."""
        new = super().expand(batch_shape, self._get_checked_instance(AdditiveGaussian, _instance))
        new._expand_primitives(self)
        return new

    def log_prob(self, value: Tensor) -> Tensor:
        r"""Return :math:`\log \sum_k \bar w_k \mathcal{N}(a; \mu_k, \sigma_k^2)`.

        Args:
            value: Actions, shape ``(*S, *B, A)``.

        Returns:
            Log-densities, shape ``(*S, *B)``.
        """
        if self._validate_args:
            self._validate_sample(value)
        log_probs = self.component_distribution.log_prob(value.unsqueeze(-2))
        gates = self.mixture_distribution.probs
        info = torch.finfo(gates.dtype)
        # Not inherited: torch raises every weight to 1e-7, so that a closed primitive would dominate the tails without
        # a gradient. The anchor cancels; relative to it, an open primitive adds at most 1 to the sum.
        shares = gates.log() + log_probs
        anchor = shares.amax(-1, keepdim=True).detach()
        # A closed primitive adds nothing, however likely the action: only its gradient needs a bound. The bound of an
        # open primitive is the range of the type, which only subnormal gates reach.
        bound = torch.where(gates > 0, math.log(info.max) - 0.5, -math.log(info.eps))
        terms = gates * (log_probs - anchor).clamp_max(bound).exp()
        terms = torch.where(gates < info.tiny, terms + ((shares - anchor).exp() - terms).detach(), terms)
        return anchor.squeeze(-1) + terms.sum(-1).log()

    def entropy(self, num_samples: int = 1) -> Tensor:
        r"""Estimate the entropy without bias in its value or its gradient.

        .. math:: H = -\sum_{k=1}^K \bar w_k \,
            \mathbb{E}_{\epsilon \sim \mathcal{N}(0, I)} \left[ \log \pi(\mu_k + \sigma_k \epsilon) \right]

        The sum over primitives is exact, and the expectation is reparametrised. TorchRL's own estimate from samples of
        the mixture has the same value, but its gradient is zero on average.

        Args:
            num_samples: Noise samples per primitive.

        Returns:
            Entropy estimates, shape ``(*B,)``.
        """
        return -self._expectation(self.log_prob, num_samples)

    def _expectation(self, function: Callable[[Tensor], Tensor], num_samples: int = 1) -> Tensor:
        """Estimate the mean of a function of actions, exactly over primitives and reparametrised within each."""
        actions = self.component_distribution.rsample((num_samples,)).movedim(-2, 0)
        gates = self.mixture_distribution.probs.movedim(-1, 0).unsqueeze(1)
        return (gates * function(actions)).sum(0).mean(0)

    def rsample(self, sample_shape: Sequence[int] = ()) -> NoReturn:
        """Raise an error, because the choice of the primitive of a sample has no derivative.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError(
            "AdditiveGaussian cannot differentiate its samples, because each comes from one primitive: use a loss of "
            "log-probabilities, such as PPO or A2C, or, for SAC and other losses that call rsample, "
            "TanhMultiplicativeGaussian or MultiplicativeGaussian"
        )

    @property
    def mode(self) -> Tensor:
        """Raise an error, because the densest action of a mixture has no closed form.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError(
            "the mode of a Gaussian mixture has no closed form: use deterministic_sample, the mean of the most likely "
            "primitive, with TorchRL as ExplorationType.DETERMINISTIC"
        )

    @property
    def deterministic_sample(self) -> Tensor:
        """The mean of the most likely primitive, shape ``(*B, A)``; the mixture's mean may lie between modes."""
        index = self.mixture_distribution.probs.argmax(-1)[..., None, None]
        # Not take_along_dim, which torch.export would restrict to the batch size of its example.
        return self.loc.gather(-2, index.expand(*self.batch_shape, 1, *self.event_shape)).squeeze(-2)


@register_kl(AdditiveGaussian, AdditiveGaussian)
@register_kl(AdditiveGaussian, Independent)
def _kl_additive(p: AdditiveGaussian, q: Distribution) -> Tensor:
    """Estimate the divergence like :meth:`AdditiveGaussian.entropy`, by one sample of noise per primitive."""
    shape = torch.broadcast_shapes(p.batch_shape, q.batch_shape)
    p, q = p.expand(shape), q.expand(shape)
    return p._expectation(lambda action: p.log_prob(action) - q.log_prob(action))


@register_kl(Independent, AdditiveGaussian)
def _kl_independent_additive(p: Independent, q: AdditiveGaussian) -> Tensor:
    """Estimate the divergence by one reparametrised sample."""
    shape = torch.broadcast_shapes(p.batch_shape, q.batch_shape)
    action = p.expand(shape).rsample()
    return p.log_prob(action) - q.log_prob(action)
