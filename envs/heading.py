"""The heading task: walk in a direction that keeps changing."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_mcp.envs.arguments import interval, not_negative
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rendering import Arrow
from torchrl_mcp.envs.rewards import heading_reward


class Heading(PDCharacterEnv):
    r"""A character walks at a given speed in a direction that wanders.

    .. math:: \hat{\theta}_t = \hat{\theta}_{t-1} + \mathrm{Uniform}(-\delta, \delta)

    ``goal`` (2) is the unit vector of the target direction in the character's heading frame. The reward of a step is
    that of the direction which the action could see.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        max_turn: Largest change :math:`\delta` of the direction per step, in radians. Paper: 0.15.
        speed: Target speed :math:`\hat{v}`, in m/s. Paper: 1.
        initial_directions: Range (lo, hi) of the first direction, in radians from where the character faces. The paper
            does not say; its returns of 0.97 leave no time to turn round, hence the default.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``; 600 are 20 s.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> env = Heading("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 105])
    """

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        max_turn: float = 0.15,
        speed: float = 1.0,
        initial_directions: Sequence[float] = (0.0, 0.0),
        max_episode_steps: int = 600,
        **kwargs: Any,
    ) -> None:
        not_negative(max_turn=max_turn, speed=speed)
        self.max_turn, self.speed = max_turn, speed
        self.initial_directions = interval("initial_directions", initial_directions)
        direction = torch.zeros((), dtype=torch.float64)
        super().__init__(
            character, num_envs, max_episode_steps=max_episode_steps, episode={"direction": direction}, **kwargs
        )
        self._make_specs()

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is the worst possible and 1 the best, :math:`\bar{R} = R / T`.

        :math:`R` is the undiscounted return and :math:`T` ``max_episode_steps``: a reward is at most 1. The paper's
        normalisation is not documented.
        """
        return episode_return / self.max_episode_steps

    def _sample(self, num: int) -> dict[str, Tensor]:
        direction = torch.empty(num, dtype=torch.float64)
        return {
            **super()._sample(num),
            "direction": direction.uniform_(*self.initial_directions, generator=self.generator),
        }

    def _observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        angle = self.heading(ids)
        return {"observation": self._state(ids, angle), "goal": unit_vector(self.episode["direction"][ids] - angle)}

    def _reward_and_termination(self, diverged: Tensor) -> tuple[Tensor, Tensor]:
        direction = self.episode["direction"]
        reward = heading_reward(self._com_velocity(), unit_vector(direction), self.speed)
        direction += torch.empty_like(direction).uniform_(-self.max_turn, self.max_turn, generator=self.generator)
        return self._unless_fallen(reward)

    def _arrows(self, index: int) -> list[Arrow]:
        tail = self._com[index] + torch.tensor([0.0, 0.0, 0.8])
        tip = tail + torch.nn.functional.pad(unit_vector(self.episode["direction"][index]), (0, 1))
        return [(tail.numpy(), tip.numpy())]


def unit_vector(angle: Tensor) -> Tensor:
    """(cos, sin) of an angle in radians, shape ``(*B, 2)``."""
    return torch.stack([angle.cos(), angle.sin()], -1)
