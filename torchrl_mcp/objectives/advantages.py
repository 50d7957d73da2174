"""Advantages and value targets for a batch of trajectories."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives.value import GAE


class Advantages:
    r"""GAE(:math:`\lambda`) with TD(:math:`\lambda`) value targets, bootstrapped at time limits.

    The critic sees every state once: the value of a next state is the value of the following sample. After a time limit
    and at the end of the batch, no sample of the same episode follows, and the critic evaluates the stored next
    observation. A terminated episode has no value beyond its end.

    Rewards are scaled by :math:`1 - \gamma` first, so that returns have the size of a reward and the critic's outputs
    are of order one for any discount.

    Args:
        critic: From ``observation`` and ``goal`` to ``state_value``.
        gamma: Discount factor.
        lmbda: Decay of both estimators.
        clip: Largest absolute advantage after normalisation to zero mean and unit variance.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1.

    Reference:
        Schulman et al., *High-Dimensional Continuous Control Using Generalized Advantage Estimation*, 2016.
    """

    out_keys = ("advantage", "value_target", "state_value")

    def __init__(self, critic: TensorDictModuleBase, *, gamma: float, lmbda: float, clip: float) -> None:
        self.critic = critic
        self.reward_scale = reward_scale(gamma)
        self.clip = clip
        self.gae = GAE(gamma=gamma, lmbda=lmbda, value_network=None)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Add ``advantage`` and ``value_target``, each ``(N, T, 1)``, to trajectories of shape ``(N, T)``."""
        value = self.critic(batch.select("observation", "goal")).get("state_value").float()
        next_value = torch.cat([value[:, 1:], torch.zeros_like(value[:, :1])], dim=1)
        cut = batch["next", "truncated"].squeeze(-1).clone()
        cut[:, -1] = True
        next_value[cut] = self.critic(batch["next"][cut].select("observation", "goal"))["state_value"].float()

        trajectories = batch.select(("next", "done"), ("next", "terminated"))
        trajectories["state_value"] = value
        trajectories["next", "state_value"] = next_value
        trajectories["next", "reward"] = batch["next", "reward"] * self.reward_scale
        self.gae(trajectories)

        batch["advantage"] = normalised(trajectories["advantage"], self.clip)
        batch["value_target"] = trajectories["value_target"]
        batch["state_value"] = value
        return batch


def normalised(advantage: Tensor, clip: float) -> Tensor:
    """Scale advantages of a batch to zero mean and unit variance, and clip them; a single one becomes 0."""
    deviation = advantage.std(correction=min(1, advantage.numel() - 1))
    return ((advantage - advantage.mean()) / deviation.clamp_min(1e-8)).clamp(-clip, clip)


def reward_scale(gamma: float) -> float:
    r"""Return the factor on rewards that gives returns the size of a reward, :math:`1 - \gamma`.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1: at 1 all rewards would be 0.
    """
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma={gamma} must be at least 0 and below 1: rewards are scaled by 1 - gamma")
    return 1 - gamma
