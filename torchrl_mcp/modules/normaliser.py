"""Running normalisation of network inputs."""

import warnings
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_mcp.values import NotNegative, PositiveOrInfinite, Whole, checked

LARGEST = 1e5
"""Bound on the features of a sample, in SI units; only diverged simulations exceed it."""


class RunningNormaliser(nn.Module):
    r"""Standardise inputs by running statistics, and clip the result.

    .. math:: y = \operatorname{clip}\left(\frac{x - m}{\sqrt{v + \epsilon}}, -c, c\right)

    The mean :math:`m` and the variance :math:`v` are buffers, which :meth:`update` changes in place. Call it once per
    training iteration, so that the samples of an iteration and the loss on these samples see the same numbers. A loss
    that copies a network, as :class:`torchrl.objectives.SACLoss` copies its critics, does not see later updates:
    normalise inputs before such a loss.

    Args:
        size: Number of input features, ``F``; 0 for a goal of a task that has none.
        clip: Largest absolute output, :math:`c`.
        epsilon: Added to the variance.

    Raises:
        ValueError: If ``size`` or ``epsilon`` is negative, or ``clip`` is not positive.

    Example:
        >>> import torch
        >>> from torchrl_mcp.modules import RunningNormaliser
        >>> normaliser = RunningNormaliser(2)
        >>> normaliser.update(torch.tensor([[0.0, 10.0], [2.0, 30.0]]))
        >>> normaliser(torch.tensor([1.0, 30.0]))
        tensor([0.0000, 1.0000])
    """

    mean: Tensor
    variance: Tensor
    count: Tensor

    @checked
    def __init__(self, size: Whole, *, clip: PositiveOrInfinite = 10.0, epsilon: NotNegative = 1e-8) -> None:
        super().__init__()
        self.clip = clip
        self.epsilon = epsilon
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def count_each(self) -> None:
        """Count the samples of each feature separately, ``(F,)``, so that single features can begin anew."""
        self.count.data = self.count.expand_as(self.mean).clone()

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``x``, shape ``(*B, F)``; the result has the floating-point type of the statistics.

        Raises:
            ValueError: If ``x`` has another number of features.
        """
        self._require_features(x)
        x = x.to(self.mean.dtype)
        return ((x - self.mean) * (self.variance + self.epsilon).rsqrt()).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Merge the samples ``x``, shape ``(*B, F)``, into the statistics.

        A sample with a feature that is not finite or exceeds ``LARGEST`` is left out with a warning, because one such
        sample would outweigh all earlier samples.

        Raises:
            ValueError: If ``x`` has another number of features.

        Reference:
            Chan, Golub and LeVeque, *Updating formulae and a pairwise algorithm for computing sample variances*, 1979.
        """
        self._require_features(x)
        x = x.reshape(x.shape[:-1].numel(), x.shape[-1]).to(self.mean.dtype)
        good = x.abs() <= LARGEST
        if not (within := good.all(-1)).all():
            features = (~good).any(0).nonzero().flatten().tolist()
            warnings.warn(
                f"{int((~within).sum())} of {len(x)} samples have features beyond {LARGEST:g} and are left out: scale "
                f"features {features}, unless the simulation diverged",
                stacklevel=2,
            )
            x = x[within]
        if not x.numel():
            return
        variance, mean = torch.var_mean(x, dim=0, correction=0)
        share = (x.shape[0] / (self.count + x.shape[0])).to(mean.dtype)
        delta = mean - self.mean
        self.variance.copy_(self.variance + share * (variance - self.variance + (1 - share) * delta.square()))
        self.mean.add_(share * delta)
        self.count.add_(x.shape[0])

    def _require_features(self, x: Tensor) -> None:
        if x.shape[-1:] != self.mean.shape:  # one feature would be broadcast
            raise ValueError(f"x is {tuple(x.shape)}: its last dimension must have {len(self.mean)} features")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Load statistics with one count for all features or with one count for each feature."""
        if (count := state_dict.get(f"{prefix}count")) is not None:
            self.count.data = self.count.new_zeros(count.shape)
        super()._load_from_state_dict(state_dict, prefix, *args)
