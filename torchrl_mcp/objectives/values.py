"""The loss of a value function."""

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_mcp.values import NotNegative


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
