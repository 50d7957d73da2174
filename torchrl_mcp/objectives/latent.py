"""PPO's loss with the regulariser of the latent space model."""

from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.distributions import Distribution, Normal, kl_divergence

from torchrl_mcp.methods.latent_space import ENCODING
from torchrl_mcp.objectives.ppo import BoundedClipPPOLoss
from torchrl_mcp.values import NotNegative


class LatentPPOLoss(BoundedClipPPOLoss):
    r"""The bounded PPO loss plus a penalty on latent variables that carry much information about the goal.

    .. math:: L + \beta \, \mathbb{E} \, D_{KL}\left[ q(w|g) \,\|\, \mathcal{N}(0, I) \right]

    The paper's Eq. 12 maximises the return *plus* this divergence, which would reward its growth. A regulariser is
    subtracted from the return, that is, added to the loss. Eq. 12 is about policy and encoder together and hence about
    pre-training, but Table 11 has one :math:`\beta` for both stages, whereas its step sizes differ by stage. We use
    the penalty in both stages; at transfer it concerns :math:`q(w|s, g)`.

    Args:
        actor_network: The module ``trained`` of an actor of :mod:`torchrl_mcp.methods.latent_space`.
        critic_network: The value function, or None if it has its own loss.
        kl_coeff: Weight of the penalty, :math:`\beta`.
        **kwargs: Passed on to :class:`~torchrl_mcp.objectives.BoundedClipPPOLoss`.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Eq. 12. https://arxiv.org/abs/1905.09808

    Example:
        >>> import torch
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.latent_space import latent_actor, latent_parts
        >>> from torchrl_mcp.modules import GaussianPolicy, StateGoalEncoder
        >>> from torchrl_mcp.objectives import LatentPPOLoss
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = latent_parts(sizes, encoder=StateGoalEncoder, decoder=GaussianPolicy, latent_dim=16)
        >>> actor = latent_actor(parts)
        >>> with torch.no_grad():
        ...     samples = Heading("biped", num_envs=4, seed=0).rollout(8, actor.policy).reshape(-1)
        >>> samples["advantage"] = torch.randn(32, 1)
        >>> loss = LatentPPOLoss(actor.trained, kl_coeff=1e-4, bound_coeff=10.0, entropy_bonus=False)
        >>> report = loss(samples)
        >>> sorted(name for name in report.keys() if name.startswith("loss_"))
        ['loss_bound', 'loss_latent', 'loss_objective']
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase | None = None,
        *,
        kl_coeff: NotNegative,
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, critic_network, **kwargs)
        self.kl_coeff = kl_coeff
        self.out_keys = [*self.out_keys, "loss_latent", "latent_kl"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add ``loss_latent`` to the terms of the bounded loss, and report the divergence as ``latent_kl`` in nats."""
        out = super().forward(tensordict)
        loc, scale = self._encoding
        prior = Normal(torch.zeros_like(loc), torch.ones_like(scale))
        kl = kl_divergence(Normal(loc, scale), prior).sum(-1)
        del self._encoding
        out["loss_latent"] = self.kl_coeff * self._reduced(kl, tensordict)
        return out.set("latent_kl", kl.detach().mean())

    def _get_cur_log_prob(
        self, tensordict: TensorDictBase, params: TensorDictParams | None = None
    ) -> tuple[Tensor, Distribution, bool]:
        outcome = super()._get_cur_log_prob(tensordict, params)
        if params is None:  # the networks have just written their outputs
            self._encoding = [tensordict[key] for key in ENCODING]
        return outcome
