"""Advantages of choices that last for several steps."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_mcp.objectives.advantages import normalised, reward_scale, state_values, upon_arrival
from torchrl_mcp.values import Discount, Positive, Share


class SemiMarkovAdvantages:
    r"""GAE(:math:`\lambda`) and TD(:math:`\lambda`) targets for choices that last several steps.

    A choice in state s that lasts k steps and leads to the state s' has the advantage

    .. math::
        A = \sum_{i=0}^{k-1} \gamma^i r_i + \gamma^k V(s') - V(s) + \gamma^k \lambda A'

    where :math:`A'` is the advantage of the next choice. The value after a terminated episode is 0. After a
    time limit and at the end of the batch there is no next choice: there the value of the last state is used, even if
    the choice would have lasted longer. A batch should therefore be much longer than a choice.

    Steps before the first choice of a batch belong to a choice of the batch before and are not used. Rewards are
    multiplied by :math:`1 - \gamma`, as in :class:`~torchrl_mcp.objectives.Advantages`.

    Args:
        critic: From keys of a state, such as ``observation`` and ``goal``, to ``state_value``.
        gamma: Discount factor of one step.
        lmbda: Decay of both estimators, from choice to choice.
        clip: Largest absolute advantage after normalisation to zero mean and unit variance.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1.

    Reference:
        Sutton, Precup and Singh, *Between MDPs and semi-MDPs: A framework for temporal abstraction in reinforcement
        learning*, 1999. https://doi.org/10.1016/S0004-3702(99)00052-1

    Example:
        A choice every fourth step:

        >>> import torch
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.objectives import SemiMarkovAdvantages
        >>> critic = ValueOperator(torch.nn.Linear(105, 1), in_keys=["observation"])
        >>> advantages = SemiMarkovAdvantages(critic, gamma=0.99, lmbda=0.95, clip=4.0)
        >>> batch = Heading("biped", num_envs=2, seed=0).rollout(8)
        >>> batch["begins"] = (torch.arange(8) % 4 == 0).expand(2, 8)
        >>> advantages(batch)["advantage"].shape  # two choices in each of two trajectories
        torch.Size([4, 1])
    """

    out_keys = ("advantage", "value_target")

    def __init__(self, critic: TensorDictModuleBase, *, gamma: Discount, lmbda: Share, clip: Positive) -> None:
        self.critic = critic
        self.gamma = gamma
        self.lmbda = lmbda
        self.clip = clip
        self.reward_scale = reward_scale(gamma)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Return the C choices of trajectories ``(*B, T)``, with ``advantage`` and ``value_target``, each ``(C, 1)``.

        Raises:
            ValueError: If the trajectories contain no choice, or their policy makes none.
        """
        if "begins" not in batch:
            raise ValueError("the policy stores no 'begins', because it makes no choices: use the objective of ppo")
        begins = batch["begins"]
        if not begins.any():
            raise ValueError(
                f"no choice was made in {batch.shape[-1]} steps of each environment: training.frames_per_batch * "
                "batch_factor / training.num_envs must be at least the steps that a choice lasts"
            )
        value = torch.zeros(*batch.shape, 1, dtype=torch.float32, device=begins.device)
        value[begins] = self._evaluate(batch[begins])
        target = self._targets(batch, value)

        choices = batch[begins]
        choices["advantage"] = normalised((target - value)[begins], self.clip)
        choices["value_target"] = target[begins]
        return choices

    def _targets(self, batch: TensorDictBase, value: Tensor) -> Tensor:
        r"""TD(:math:`\lambda`) returns from every step, given the values where choices begin, ``(*B, T, 1)`` each."""
        terminated = batch["next", "terminated"]
        done = batch["next", "done"].clone()
        done[..., -1, :] = True
        next_value = upon_arrival(value, batch, self._evaluate).masked_fill(terminated, 0.0)
        lmbda = self.lmbda * (~done).to(value.dtype)
        ends = done | batch["begins"].roll(-1, dims=-1).unsqueeze(-1)
        reward = self.reward_scale * batch["next", "reward"].to(value.dtype)
        target = torch.empty_like(value)
        later = torch.zeros_like(value[..., 0, :])
        for t in reversed(range(batch.shape[-1])):
            bootstrapped = torch.lerp(next_value[..., t, :], later, lmbda[..., t, :])
            after = torch.where(ends[..., t, :], bootstrapped, later)
            target[..., t, :] = later = reward[..., t, :] + self.gamma * after
        return target

    def _evaluate(self, states: TensorDictBase) -> Tensor:
        return state_values(self.critic, states)
