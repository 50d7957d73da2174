"""PPO's loss with the latent space model's regulariser."""

from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.distributions import Distribution, Normal, kl_divergence

from torchrl_mcp.methods.latent_space import ENCODING
from torchrl_mcp.objectives.ppo import BoundedClipPPOLoss


class LatentPPOLoss(BoundedClipPPOLoss):
    r"""The bounded PPO loss plus a penalty on latent codes with much information about the goal.

    .. math:: L + \beta \, \mathbb{E} \, D_{KL}\left[ q(w|g) \,\|\, \mathcal{N}(0, I) \right]

    The paper's Eq. 12 maximises return *plus* this divergence, which would reward its growth; a regulariser is
    subtracted from the return, hence added to the loss. Eq. 12 is stated for policy and encoder together, hence for
    pre-training, but Table 11 has one :math:`\beta` for both stages, whereas its step sizes differ by stage. Here the
    penalty acts in both, on :math:`q(w|s, g)` at transfer.

    Args:
        actor_network: The policy, of :func:`torchrl_mcp.methods.latent_space.latent_actor`.
        critic_network: The value function, or None if it has its own loss.
        kl_coeff: Weight of the penalty, :math:`\beta`.
        **kwargs: Passed on to :class:`~torchrl_mcp.objectives.BoundedClipPPOLoss`.

    Reference:
        Peng et al., *MCP*, NeurIPS 2019, Eq. 12. https://arxiv.org/abs/1905.09808
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModuleBase | None = None,
        *,
        kl_coeff: float,
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
