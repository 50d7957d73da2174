"""Options: policies that do not see the goal. One of them acts at a time, chosen by a policy that sees the goal."""

import math
from collections.abc import Callable
from typing import NoReturn, Self

import torch
from torch import Size, Tensor, nn
from torch.distributions import Categorical, Distribution

from torchrl_mcp.modules.gating import relu_mlp, scaled_cells, scaled_linear
from torchrl_mcp.values import Count, Positive, Probability, Widths, checked


class SeparateOptions(nn.Module):
    r"""K policies :math:`\pi_\omega(a|s)` without a shared weight; each evaluates only the samples in which it acts.

    Args:
        observation_dim: Size of the state, ``S``.
        action_dim: Size of the action, ``A``.
        num_options: Number of options, ``K``.
        policy: Makes the network of one option, such as the scratch model's, from ``(S, G, A)``, with ``G = 0``.

    Example:
        >>> import torch
        >>> from torchrl_mcp.methods.options import SeparateOptions
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> options = SeparateOptions(observation_dim=105, action_dim=17, num_options=7, policy=GaussianPolicy)
        >>> loc, scale = options(torch.randn(16, 105), torch.randint(7, (16,)))
        >>> loc.shape, scale.shape
        (torch.Size([16, 17]), torch.Size([16, 17]))
    """

    @checked
    def __init__(
        self, observation_dim: int, action_dim: int, num_options: Count, *, policy: Callable[..., nn.Module]
    ) -> None:
        super().__init__()
        self.policies = nn.ModuleList(policy(observation_dim, 0, action_dim) for _ in range(num_options))

    def forward(self, observation: Tensor, option: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, each ``(*B, A)``, of the options ``(*B)`` in the states ``(*B, S)``."""
        order = option.flatten().argsort()
        counts = option.flatten().bincount(minlength=len(self.policies)).tolist()
        states = observation.reshape(-1, observation.shape[-1])[order].split(counts)
        outputs = [policy(state, state[:, :0]) for policy, state in zip(self.policies, states, strict=True)]
        back = order.argsort()
        loc = torch.cat([mean for mean, _ in outputs])[back]
        scale = torch.cat([std for _, std in outputs])[back]
        return loc.reshape(*option.shape, loc.shape[-1]), scale.reshape(*option.shape, scale.shape[-1])


class Terminations(nn.Module):
    r"""The probabilities :math:`\beta_\omega(s)` with which options end.

    Args:
        observation_dim: Size of the state, ``S``.
        num_options: Number of options, ``K``.
        num_cells: Hidden units.
        width: Factor on all numbers of hidden units.
        initial: Probability before training. An option then lasts ``1 / initial`` steps on average.

    Raises:
        ValueError: If ``initial`` is not between 0 and 1.

    Example:
        >>> import torch
        >>> from torchrl_mcp.methods.options import Terminations
        >>> terminations = Terminations(observation_dim=105, num_options=8, num_cells=[256], initial=0.1)
        >>> terminations(torch.randn(16, 105)).shape
        torch.Size([16, 8])
    """

    @checked
    def __init__(
        self,
        observation_dim: int,
        num_options: Count,
        *,
        num_cells: Widths,
        initial: Probability,
        width: Positive = 1.0,
    ) -> None:
        super().__init__()
        num_cells = scaled_cells(num_cells, width)
        self.body = relu_mlp(observation_dim, num_cells)
        self.output = scaled_linear(num_cells[-1], num_options, gain=0.01)
        nn.init.constant_(self.output.bias, math.log(initial / (1 - initial)))

    def forward(self, observation: Tensor) -> Tensor:
        """Return probabilities ``(*B, K)`` from a state ``(*B, S)``."""
        return self.output(self.body(observation)).float().sigmoid()


class WhereBeginning(nn.Module):
    """Scores that are evaluated only for samples in which an option begins, and are zero for the others.

    Args:
        scores: From state ``(n, S)`` and goal ``(n, G)`` to ``(n, K)``.
        num_options: Number of options, ``K``.
    """

    def __init__(self, scores: nn.Module, num_options: Count) -> None:
        super().__init__()
        self.scores = scores
        self.num_options = num_options

    def forward(self, observation: Tensor, goal: Tensor, begins: Tensor) -> Tensor:
        """Return scores ``(*B, K)``."""
        scores = torch.zeros(*begins.shape, self.num_options, dtype=torch.float32, device=begins.device)
        scores[begins] = self.scores(observation[begins], goal[begins]).float()
        return scores


class RandomSequence:
    """An explorer that lets one option act after another in random order, and plays mean actions.

    Args:
        options: From states and the options that act, ``(N,)``, to means and standard deviations, each ``(N, A)``.
        num: Number of simulations, ``N``.
        generator: Source of randomness.
        num_options: Number of options, ``K``.
        steps: Control steps for which each option acts.
    """

    def __init__(
        self,
        options: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
        num: int,
        generator: torch.Generator,
        *,
        num_options: Count,
        steps: Count,
    ) -> None:
        self._options = options
        self._num = num
        self._generator = generator
        self._num_options = num_options
        self._steps = steps
        self._elapsed = 0
        self._option = torch.zeros(num, dtype=torch.int64, device=generator.device)

    def __call__(self, state: Tensor) -> Tensor:
        """Return the actions of the next step, ``(N, A)``, from states ``(N, S)``."""
        if self._elapsed % self._steps == 0:
            device = self._generator.device
            self._option = torch.randint(self._num_options, (self._num,), generator=self._generator, device=device)
        self._elapsed += 1
        return self._options(state, self._option)[0]


class Choice(Categorical):
    """A distribution over options. It has no mean, because numbers of options are names."""

    @property
    def mean(self) -> NoReturn:
        """Raise an error.

        Raises:
            ValueError: Always; TorchRL would replace a ``NotImplementedError`` by a mean of samples.
        """
        raise ValueError("options have no mean: use ExplorationType.DETERMINISTIC, the likeliest option, or RANDOM")

    @property
    def deterministic_sample(self) -> Tensor:
        """The likeliest option, ``(*B)``."""
        return self.mode


class EpsilonGreedy(Choice):
    r"""The policy over options: the option of highest value, or with probability :math:`\epsilon` a random option.

    .. math:: \pi_\Omega(\omega|s, g) = (1 - \epsilon) [\omega = \arg\max Q_\Omega(s, g, \cdot)] + \epsilon / K

    Args:
        values: Values of the options, shape ``(*B, K)``.
        epsilon: Probability :math:`\epsilon` of a random choice.

    Raises:
        ValueError: If ``epsilon`` is not between 0 and 1.

    Example:
        >>> import torch
        >>> from torchrl_mcp.methods.options import EpsilonGreedy
        >>> EpsilonGreedy(torch.tensor([0.0, 2.0, 1.0, 0.0]), epsilon=0.2).probs
        tensor([0.0500, 0.8500, 0.0500, 0.0500])
    """

    def __init__(self, values: Tensor, epsilon: float) -> None:
        if not 0 <= epsilon <= 1:
            raise ValueError(f"epsilon={epsilon} must be a probability: pass a number from 0 to 1")
        self._best = values.argmax(-1)
        best = nn.functional.one_hot(self._best, values.shape[-1])
        super().__init__(probs=(1 - epsilon) * best + epsilon / values.shape[-1])

    def expand(self, batch_shape: Size | list[int] | tuple[int, ...], _instance: Distribution | None = None) -> Self:
        """Return the same distribution over a larger batch, without copying."""
        new = super().expand(batch_shape, self._get_checked_instance(EpsilonGreedy, _instance))
        new._best = self._best.expand(batch_shape)
        return new

    @property
    def deterministic_sample(self) -> Tensor:
        """The option of highest value, ``(*B)``."""
        return self._best


def keep_option(begins: Tensor, drawn_option: Tensor, previous_option: Tensor) -> Tensor:
    """Return drawn options where an option begins, and the options of the previous step elsewhere, each ``(*B)``."""
    return torch.where(begins, drawn_option, previous_option)


def of_option(values: Tensor, option: Tensor) -> Tensor:
    """Select the values ``(*B, 1)`` of options, ``(*B)`` or a single one, from the values of all, ``(*B, K)``."""
    return values.gather(-1, option.unsqueeze(-1).expand(*values.shape[:-1], 1))


def option_diagnostics(option: Tensor, begins: Tensor, num_options: Count) -> dict[str, Tensor]:
    """Summarise which options act and for how long: whether one option does everything, or options switch all the time.

    - ``usage_k`` is the share of steps in which option k acts.
    - ``effective_options`` is the exponential of the entropy of these shares: 1 if one option does everything.
    - ``begin_rate`` is the share of steps in which an option begins, at the start of an episode or after another.
    - ``duration`` is the inverse of ``begin_rate``: the mean number of steps for which an option acts.

    Args:
        option: The option that acts, shape ``(*B)``, int64.
        begins: Whether it was chosen in this step, shape ``(*B)``, bool.
        num_options: Number of options, ``K``.

    Returns:
        The diagnostics by name, each a scalar.

    Example:
        >>> import torch
        >>> from torchrl_mcp.methods.options import option_diagnostics
        >>> option, begins = torch.tensor([0, 0, 1, 1]), torch.tensor([True, False, True, False])
        >>> report = option_diagnostics(option, begins, num_options=3)
        >>> report["effective_options"], report["duration"]
        (tensor(2.), tensor(2.))
    """
    usage = option.flatten().bincount(minlength=num_options) / option.numel()
    rate = begins.float().mean()
    return {
        "effective_options": torch.special.entr(usage).sum().exp(),
        "begin_rate": rate,
        "duration": rate.reciprocal(),
        **{f"usage_{k}": share for k, share in enumerate(usage)},
    }
