"""The option-critic: its estimates from trajectories, and its losses."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictParams,
    TensorDictSequential,
    dispatch,
)
from torch import Tensor
from torch.distributions import Distribution

from torchrl_mcp.methods.options import EpsilonGreedy, of_option
from torchrl_mcp.objectives.advantages import ScaledGAE, normalised, upon_arrival
from torchrl_mcp.objectives.ppo import BoundedClipPPOLoss, ValueLoss
from torchrl_mcp.values import Discount, NotNegative, Positive, Share


class OptionAdvantages:
    r"""Advantages of actions and of terminations, and targets for the values of options.

    .. math::
        \delta_t &= r_t + \gamma U(\omega_t, s_{t+1}) - Q_\Omega(s_t, \omega_t) \\
        A_t &= \delta_t + \gamma \lambda A_{t+1} \\
        U(\omega, s') &= Q_\Omega(s', \omega) - \beta_\omega(s') A_\Omega(s', \omega), \qquad
        A_\Omega(s', \omega) = Q_\Omega(s', \omega) - V_\Omega(s') \\
        V_\Omega(s) &= \sum_\omega \pi_\Omega(\omega|s) Q_\Omega(s, \omega)

    - The advantage of actions is :math:`A_t`.
    - The target of values is :math:`Q_\Omega(s_t, \omega_t) + A_t`.
    - The advantage of terminations is :math:`A_\Omega(s_{t+1}, \omega_t) + \xi`.

    With :math:`\lambda = 0` these are the one-step estimates of Bacon et al. A terminated episode has the value 0 and
    no option after its end. An episode that a time limit or the end of the batch cuts off is bootstrapped.

    Rewards are multiplied by :math:`1 - \gamma`, as in :class:`~torchrl_mcp.objectives.Advantages`, so that values have
    the size of a reward. The advantage of terminations and :math:`\xi` are in units of returns, which are
    :math:`1 / (1 - \gamma)` times as large.

    Args:
        critic: From keys of a state, such as ``observation`` and ``goal``, to ``option_values`` and ``terminations``.
        gamma: Discount factor.
        lmbda: Decay of the estimators.
        clip: Largest absolute advantage of an action after normalisation to zero mean and unit variance.
        epsilon: Probability of a random choice in the policy over options, :math:`\pi_\Omega`.
        termination_cost: :math:`\xi`, in units of returns, which keeps options from ending at every step.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1.

    Reference:
        Bacon, Harb and Precup, *The Option-Critic Architecture*, AAAI 2017. https://arxiv.org/abs/1609.05140

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.option_critic import option_critic_actor, option_critic_parts, option_values
        >>> from torchrl_mcp.methods.options import Terminations
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> from torchrl_mcp.modules import Primitives
        >>> from torchrl_mcp.objectives import OptionAdvantages
        >>> networks = {"options": Primitives, "terminations": partial(Terminations, num_cells=[256], initial=0.1)}
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = option_critic_parts(sizes, **networks, values_cells=[256], num_options=8)
        >>> actor, critic = option_critic_actor(parts, num_options=8, epsilon=0.1), option_values(parts, sizes)
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=4, seed=0), OptionMemory())
        >>> with torch.no_grad():
        ...     batch = env.rollout(8, actor.policy)
        >>> advantages = OptionAdvantages(critic, gamma=0.99, lmbda=0.5, clip=4.0, epsilon=0.1, termination_cost=0.01)
        >>> batch = advantages(batch)
        >>> batch["advantage"].shape, batch["value_target"].shape, batch["termination_advantage"].shape
        (torch.Size([4, 8, 1]), torch.Size([4, 8, 1]), torch.Size([4, 8, 1]))
    """

    out_keys = ("advantage", "value_target", "termination_advantage", ("next", "observation"))

    def __init__(
        self,
        critic: TensorDictModuleBase,
        *,
        gamma: Discount,
        lmbda: Share,
        clip: Positive,
        epsilon: Share,
        termination_cost: NotNegative,
    ) -> None:
        self.critic = critic
        self.clip = clip
        self.epsilon = epsilon
        self.termination_cost = termination_cost
        self.gae = ScaledGAE(gamma, lmbda)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Add the estimates, each ``(*B, T, 1)``, to trajectories of shape ``(*B, T)``."""
        option = batch["option"]
        outputs = self._criticised(batch)
        values, terminations = upon_arrival(outputs, batch, self._criticised).chunk(2, dim=-1)
        kept = of_option(values, option)
        chosen = (EpsilonGreedy(values, self.epsilon).probs * values).sum(-1, keepdim=True)
        value = of_option(outputs.chunk(2, dim=-1)[0], option)
        next_value = kept - of_option(terminations, option) * (kept - chosen)
        advantage, batch["value_target"] = self.gae(batch, value, next_value)
        batch["advantage"] = normalised(advantage, self.clip)
        regret = (kept - chosen) / self.gae.reward_scale + self.termination_cost
        batch["termination_advantage"] = regret * ~batch["next", "terminated"]
        return batch

    def _criticised(self, states: TensorDictBase) -> Tensor:
        """Values of all options, then their terminations, ``(*B, 2 K)``."""
        criticised = self.critic(states.select(*self.critic.in_keys))
        return torch.cat([criticised["option_values"], criticised["terminations"]], dim=-1).float()


class OptionValueLoss(ValueLoss):
    r"""Mean squared error of the values of the options that acted.

    .. math:: L = c \, \mathbb{E} (Q_\Omega(s, \omega) - y)^2

    With :math:`c = 1/2` the gradient is that of intra-option Q-learning. The loss evaluates only the values and not the
    terminations, because these belong to the actor, which may learn at the same time.

    Args:
        critic_network: Sequence from ``observation`` and ``goal`` to ``option_values``, ``(B, K)``, and other keys.
        coeff: Weight of the error, :math:`c`.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.option_critic import option_critic_actor, option_critic_parts, option_values
        >>> from torchrl_mcp.methods.options import Terminations
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> from torchrl_mcp.modules import Primitives
        >>> from torchrl_mcp.objectives import OptionAdvantages, OptionValueLoss
        >>> networks = {"options": Primitives, "terminations": partial(Terminations, num_cells=[256], initial=0.1)}
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = option_critic_parts(sizes, **networks, values_cells=[256], num_options=8)
        >>> actor, critic = option_critic_actor(parts, num_options=8, epsilon=0.1), option_values(parts, sizes)
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=4, seed=0), OptionMemory())
        >>> with torch.no_grad():
        ...     batch = env.rollout(8, actor.policy)
        >>> advantages = OptionAdvantages(critic, gamma=0.99, lmbda=0.5, clip=4.0, epsilon=0.1, termination_cost=0.01)
        >>> samples = advantages(batch).reshape(-1)
        >>> sorted(OptionValueLoss(critic, coeff=0.5)(samples).keys())
        ['explained_variance', 'loss_critic']
    """

    def __init__(self, critic_network: TensorDictSequential, *, coeff: NotNegative) -> None:
        super().__init__(critic_network.select_subsequence(out_keys=["option_values"]), coeff=coeff)

    def _values(self, samples: TensorDictBase) -> Tensor:
        values = self.critic_network(samples.select(*self.critic_network.in_keys))["option_values"]
        return of_option(values, samples["option"])


class OptionCriticLoss(BoundedClipPPOLoss):
    r"""The loss of the options and their terminations. The values have :class:`OptionValueLoss`.

    .. math::
        L = -\mathbb{E} \min(\rho A, \operatorname{clip}(\rho, 1 - \epsilon, 1 + \epsilon) A)
        + \mathbb{E} \, \beta_\omega(s') (A_\Omega(s', \omega) + \xi)
        + c \, \mathbb{E} \sum_j \max(0, |\mu_j| - b)^2

    with :math:`\rho = \pi_\omega(a|s) / \pi_\omega^{\mathrm{old}}(a|s)`. If each sample is used once,
    :math:`\rho = 1`, and the gradients of the first two terms are those of the intra-option policy gradient theorem and
    of the termination gradient theorem. The clipped ratio allows samples to be used several times. If the terminations
    are frozen, ``actor_network`` does not return ``termination``, and the loss has no second term.

    Args:
        actor_network: From a sample to the distribution of ``action``, and to ``termination``,
            :math:`\beta_\omega(s')`.
        critic_network: The value function, or None if it has its own loss.
        **kwargs: Passed on to :class:`~torchrl_mcp.objectives.BoundedClipPPOLoss`.

    Reference:
        Bacon, Harb and Precup, *The Option-Critic Architecture*, AAAI 2017, Theorems 1 and 2 and Algorithm 1.
        https://arxiv.org/abs/1609.05140

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.option_critic import option_critic_actor, option_critic_parts, option_values
        >>> from torchrl_mcp.methods.options import Terminations
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> from torchrl_mcp.modules import Primitives
        >>> from torchrl_mcp.objectives import OptionAdvantages, OptionCriticLoss
        >>> networks = {"options": Primitives, "terminations": partial(Terminations, num_cells=[256], initial=0.1)}
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = option_critic_parts(sizes, **networks, values_cells=[256], num_options=8)
        >>> actor, critic = option_critic_actor(parts, num_options=8, epsilon=0.1), option_values(parts, sizes)
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=4, seed=0), OptionMemory())
        >>> with torch.no_grad():
        ...     batch = env.rollout(8, actor.policy)
        >>> advantages = OptionAdvantages(critic, gamma=0.99, lmbda=0.5, clip=4.0, epsilon=0.1, termination_cost=0.01)
        >>> samples = advantages(batch).reshape(-1)
        >>> loss = OptionCriticLoss(actor.trained, clip_epsilon=0.2, bound_coeff=10.0, entropy_bonus=False)
        >>> report = loss(samples)
        >>> sorted(name for name in report.keys() if name.startswith("loss_"))
        ['loss_bound', 'loss_objective', 'loss_termination']
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, critic_network, **kwargs)
        if "termination" in self.actor_network.out_keys:
            self.out_keys = [*self.out_keys, "loss_termination"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add ``loss_termination`` to the terms of the bounded loss."""
        out = super().forward(tensordict)
        if "termination" in self.actor_network.out_keys:
            regret = tensordict["termination_advantage"].squeeze(-1)
            out["loss_termination"] = self._reduced(self._termination * regret, tensordict)
            del self._termination
        return out

    def _get_cur_log_prob(
        self, tensordict: TensorDictBase, params: TensorDictParams | None = None
    ) -> tuple[Tensor, Distribution, bool]:
        outcome = super()._get_cur_log_prob(tensordict, params)
        if params is None and "termination" in self.actor_network.out_keys:  # just written by the networks
            self._termination = tensordict["termination"]
        return outcome
