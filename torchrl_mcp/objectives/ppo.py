"""The losses of PPO for actor and critic, and what the training loop requires of the loss of an actor."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, TensorDictParams, dispatch
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.objectives import ClipPPOLoss

from torchrl_mcp.values import NotNegative, Positive

REPORTS = ("kl_approx", "mean_ratio")
"""Outputs from which the loop estimates the KL divergence of an update, as TorchRL's PPO losses name them."""


class ActorLoss(nn.Module):
    r"""Base class for a loss of an actor that is not a subclass of TorchRL's ``ClipPPOLoss``.

    The forward pass takes samples ``(B,)`` and returns scalars: the terms to minimise, whose names begin with
    ``loss_``, and reports. Let :math:`r` be the probability of a sample under the present policy divided by its
    probability under the policy that collected it. Two reports are required:

    - ``mean_ratio`` is :math:`E[r]`.
    - ``kl_approx`` is :math:`-E[\log r]`, in nats.

    A run makes the loss from the part of the policy that learns, ``Actor.trained``, and then calls :meth:`set_keys`.
    On the command line, ``~objective.loss '+objective.loss={_target_: my_losses.PolicyGradient, _partial_: true}'``
    replaces the loss of PPO.

    Attributes:
        out_keys: Names of all outputs.
        sampled: Key of what the policy samples: the action or, for example, the logits of the gate.
        log_prob: Key of its log-probability under the policy that collected it.

    Example:
        The policy gradient without clipping:

        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.objectives import ActorLoss
        >>> class PolicyGradient(ActorLoss):
        ...     out_keys = ["loss_objective", "mean_ratio", "kl_approx"]
        ...
        ...     def __init__(self, policy):
        ...         super().__init__()
        ...         self.policy = policy
        ...
        ...     def forward(self, samples):
        ...         log_prob = self.policy.get_dist(samples).log_prob(samples[self.sampled])
        ...         log_ratio = log_prob - samples[self.log_prob]
        ...         return TensorDict(
        ...             loss_objective=-(log_prob * samples["advantage"].squeeze(-1)).mean(),
        ...             mean_ratio=log_ratio.exp().mean(),
        ...             kl_approx=-log_ratio.mean(),
        ...         )
    """

    out_keys: list[str]
    sampled: NestedKey = "action"
    log_prob: NestedKey = "action_log_prob"

    def set_keys(self, *, action: NestedKey, sample_log_prob: NestedKey) -> None:
        """Set ``sampled`` and ``log_prob``, which TorchRL's losses call ``action`` and ``sample_log_prob``."""
        self.sampled = action
        self.log_prob = sample_log_prob


def require_reports(loss: nn.Module) -> None:
    """Check that a loss declares the outputs that the loop reads.

    Raises:
        ValueError: If the loss does not declare them.
    """
    if missing := [name for name in REPORTS if name not in getattr(loss, "out_keys", ())]:
        raise ValueError(
            f"{type(loss).__name__} does not report {' and '.join(missing)}: return these values with the loss, name "
            "them in its out_keys, and derive the loss from torchrl_mcp.objectives.ActorLoss"
        )


class BoundedClipPPOLoss(ClipPPOLoss):
    r"""TorchRL's clipped PPO loss plus a penalty that keeps the mean action inside its bounds.

    .. math:: L = L^{\mathrm{clip}} + c \, \mathbb{E} \sum_j \max(0, |\mu_j| - b)^2

    The environment clips actions to the bounds. Without the penalty, nothing would therefore pull a mean action outside
    the bounds back.

    Args:
        actor_network: The policy.
        critic_network: The value function, or None if it has its own loss.
        bound_coeff: Weight of the penalty, :math:`c`; 0 for distributions without a mean. For a mixture, the penalty
            concerns the mean of the mixture, which may be inside the bounds even if means of primitives are not.
        bound: Largest absolute mean action, :math:`b`.
        entropy_bonus: Whether the policy's entropy, with its weight ``entropy_coeff``, is part of the loss.
        entropy_coeff: Weight of the entropy in nats; None takes TorchRL's default. With 0, the entropy is not computed.
        **kwargs: Passed on to :class:`torchrl.objectives.ClipPPOLoss`.

    Reference:
        Peng et al., *DeepMimic: Example-Guided Deep Reinforcement Learning of Physics-Based Character Skills*, 2018,
        whose code bounds actions in this way; the MCP paper does not mention it.

    Example:
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.critic import value_critic
        >>> from torchrl_mcp.methods.scratch import gaussian_actor, gaussian_parts
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> from torchrl_mcp.objectives import Advantages, BoundedClipPPOLoss
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = gaussian_parts(sizes, policy=GaussianPolicy)
        >>> actor, critic = gaussian_actor(parts), value_critic(parts, sizes)
        >>> env = Heading("biped", num_envs=4, seed=0)
        >>> with torch.no_grad():
        ...     batch = env.rollout(8, actor.policy)
        >>> samples = Advantages(critic, gamma=0.99, lmbda=0.95, clip=4.0)(batch).reshape(-1)
        >>> loss = BoundedClipPPOLoss(actor.trained, bound_coeff=10.0, clip_epsilon=0.2, entropy_bonus=False)
        >>> report = loss(samples)
        >>> sorted(name for name in report.keys() if name.startswith("loss_"))
        ['loss_bound', 'loss_objective']
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase | None = None,
        *,
        bound_coeff: NotNegative,
        bound: Positive = 1.0,
        entropy_bonus: bool = True,
        entropy_coeff: NotNegative | None = None,
        **kwargs: Any,
    ) -> None:
        bonus = entropy_bonus and entropy_coeff != 0
        super().__init__(actor_network, critic_network, entropy_bonus=bonus, entropy_coeff=entropy_coeff, **kwargs)
        self.bound_coeff = bound_coeff
        self.bound = bound
        self.out_keys: list[str] = [*self.out_keys, "loss_bound"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add ``loss_bound`` to the terms of the clipped loss."""
        out = super().forward(tensordict)
        penalty = torch.zeros_like(out["loss_objective"])
        if self.bound_coeff:
            excess = (self._distribution.mean.abs() - self.bound).relu()
            penalty = self.bound_coeff * self._reduced(excess.square().sum(-1), tensordict)
        del self._distribution
        return out.set("loss_bound", penalty)

    def _get_cur_log_prob(
        self, tensordict: TensorDictBase, params: TensorDictParams | None = None
    ) -> tuple[Tensor, Distribution, bool]:
        log_prob, distribution, is_composite = super()._get_cur_log_prob(tensordict, params)
        if params is None:  # with delay_actor, TorchRL also asks for the policy of the target's parameters
            self._distribution = distribution
        return log_prob, distribution, is_composite

    def _reduced(self, errors: Tensor, samples: TensorDictBase) -> Tensor:
        """Reduce errors ``(*B,)`` as TorchRL reduces its own: by ``reduction``, without padding."""
        return self._reduce_loss(errors.unsqueeze(-1), samples).squeeze(-1)


class ValueLoss(nn.Module):
    r"""Mean squared error of a value function against its targets.

    .. math:: L = c \, \mathbb{E} \, (V(s, g) - y)^2

    This is the ``loss_critic`` of TorchRL's PPO with ``loss_critic_type="l2"``. It has no terms of the actor, so that
    actor and critic can learn at the same time.

    Args:
        critic_network: From ``observation`` and ``goal`` to ``state_value``, ``(B, 1)``.
        coeff: Weight of the error, :math:`c`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl_mcp.objectives import ValueLoss
        >>> critic = ValueOperator(torch.nn.Linear(3, 1), in_keys=["observation"])
        >>> samples = TensorDict({"observation": torch.randn(16, 3), "value_target": torch.zeros(16, 1)}, [16])
        >>> sorted(ValueLoss(critic, coeff=1.0)(samples).keys())
        ['explained_variance', 'loss_critic']
    """

    def __init__(self, critic_network: TensorDictModuleBase, *, coeff: NotNegative) -> None:
        super().__init__()
        self.critic_network = critic_network
        self.coeff = coeff

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_critic`` of samples ``(B,)``, and the ``explained_variance`` of the targets as a share.

        Raises:
            ValueError: If ``value_target`` has another shape than the values, ``(B, 1)``.
        """
        target = tensordict["value_target"]
        values = self._values(tensordict)
        if target.shape != values.shape:
            shapes = f"shape {tuple(target.shape)}, but values have {tuple(values.shape)}"
            raise ValueError(f"value_target has {shapes}: give both the same shape, for example by unsqueeze(-1)")
        residual = target - values
        with torch.no_grad():
            explained = 1 - residual.var(correction=0) / target.var(correction=0).clamp_min(1e-8)
        return TensorDict({"loss_critic": self.coeff * residual.square().mean(), "explained_variance": explained})

    def _values(self, samples: TensorDictBase) -> Tensor:
        return self.critic_network(samples.select(*self.critic_network.in_keys))["state_value"]
