"""PPO's loss with a penalty on out-of-bounds actions."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, TensorDictParams, dispatch
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives import ClipPPOLoss

from torchrl_mcp.values import NotNegative, Positive


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
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, critic_network, **kwargs)
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
