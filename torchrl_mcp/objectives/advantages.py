"""Advantages and value targets for a batch of trajectories."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives.value import GAE

from torchrl_mcp.values import Discount, Positive, Share, checked


class Advantages:
    r"""GAE(:math:`\lambda`) with TD(:math:`\lambda`) value targets, bootstrapped at time limits.

    The critic evaluates every state once, because the value of a next state is the value of the following sample. After
    a time limit and at the end of the batch, no sample of the same episode follows: there the critic evaluates the
    stored next observation. The value after a terminated episode is 0.

    Rewards are multiplied by :math:`1 - \gamma` first. Returns therefore have the size of a reward, and the outputs of
    the critic are of order one for any discount factor.

    Args:
        critic: From keys of a state, such as ``observation`` and ``goal``, to ``state_value``.
        gamma: Discount factor.
        lmbda: Decay of both estimators.
        clip: Largest absolute advantage after normalisation to zero mean and unit variance.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1.

    Reference:
        Schulman et al., *High-Dimensional Continuous Control Using Generalized Advantage Estimation*, 2016.

    Example:
        >>> import torch
        >>> from torchrl.modules import ValueOperator
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.objectives import Advantages
        >>> critic = ValueOperator(torch.nn.Linear(105, 1), in_keys=["observation"])
        >>> advantages = Advantages(critic, gamma=0.99, lmbda=0.95, clip=4.0)
        >>> batch = advantages(Heading("biped", num_envs=4, seed=0).rollout(8))
        >>> batch["advantage"].shape, batch["value_target"].shape
        (torch.Size([4, 8, 1]), torch.Size([4, 8, 1]))
    """

    out_keys = ("advantage", "value_target")

    def __init__(self, critic: TensorDictModuleBase, *, gamma: Discount, lmbda: Share, clip: Positive) -> None:
        self.critic = critic
        self.clip = clip
        self.gae = ScaledGAE(gamma, lmbda)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Add ``advantage`` and ``value_target``, each ``(*B, T, 1)``, to trajectories of shape ``(*B, T)``."""
        value = self._evaluate(batch)
        advantage, batch["value_target"] = self.gae(batch, value, upon_arrival(value, batch, self._evaluate))
        batch["advantage"] = normalised(advantage, self.clip)
        return batch

    def _evaluate(self, states: TensorDictBase) -> Tensor:
        return state_values(self.critic, states)


class ScaledGAE:
    r"""TorchRL's GAE(:math:`\lambda`) of rewards that are scaled by :math:`1 - \gamma`.

    Args:
        gamma: Discount factor.
        lmbda: Decay of the estimators.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1.
    """

    def __init__(self, gamma: Discount, lmbda: Share) -> None:
        self.reward_scale = reward_scale(gamma)
        # The vectorised form is a convolution, which would be in bfloat16 under autocast.
        self.estimator = GAE(gamma=gamma, lmbda=lmbda, value_network=None, vectorized=False)

    def __call__(self, batch: TensorDictBase, value: Tensor, next_value: Tensor) -> tuple[Tensor, Tensor]:
        """Return advantages and targets of values, each ``(*B, T, 1)``, for trajectories ``(*B, T)`` with values."""
        trajectories = batch.select(("next", "done"), ("next", "terminated"))
        trajectories["state_value"] = value
        trajectories["next", "state_value"] = next_value
        trajectories["next", "reward"] = self.reward_scale * batch["next", "reward"].to(value.dtype)
        self.estimator(trajectories)
        return trajectories["advantage"], trajectories["value_target"]


def state_values(critic: TensorDictModuleBase, states: TensorDictBase) -> Tensor:
    """Return the values of states ``(*B)`` under a critic, ``(*B, 1)``, in ``float32``."""
    values: Tensor = critic(states.select(*critic.in_keys))["state_value"]
    return values.float()


def upon_arrival(values: Tensor, batch: TensorDictBase, evaluate: Callable[[TensorDictBase], Tensor]) -> Tensor:
    """Return values of the states in which the steps of trajectories end, ``(*B, T, F)``.

    The value after a step is the value of the following sample. After an episode that ends without being terminated,
    for example by a time limit, and at the end of the batch, no sample of the same episode follows: there the stored
    next state is evaluated. After a terminated episode the values have no meaning.

    Args:
        values: Values of the states in which the steps begin, ``(*B, T, F)``.
        batch: The trajectories, ``(*B, T)``.
        evaluate: From states ``(M,)`` to values ``(M, F)``.
    """
    after = batch["next"]
    # "truncated" is not read, because users' transforms may not write it
    cut = (after["done"] & ~after["terminated"]).squeeze(-1)
    cut[..., -1] = True
    arrived = values.roll(-1, dims=-2)
    arrived[cut] = evaluate(after[cut])
    return arrived


def normalised(advantage: Tensor, clip: Positive) -> Tensor:
    """Scale advantages of a batch to zero mean and unit variance, and clip them; a single advantage becomes 0."""
    deviation = advantage.std(correction=min(1, advantage.numel() - 1))
    return ((advantage - advantage.mean()) / deviation.clamp_min(1e-8)).clamp(-clip, clip)


@checked
def reward_scale(gamma: Discount) -> float:
    r"""Return the factor on rewards that gives returns the size of a reward, :math:`1 - \gamma`.

    Raises:
        ValueError: If ``gamma`` is not at least 0 and below 1: at 1 all rewards would be 0.
    """
    return 1 - gamma
