"""The heading task: walk in a direction that keeps changing."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_mcp.envs.arguments import not_negative, positive
from torchrl_mcp.envs.ideal import Reach
from torchrl_mcp.envs.mirror import VECTOR_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.rendering import Arrow
from torchrl_mcp.envs.rewards import heading_reward
from torchrl_mcp.envs.transfer import TransferTask


class Heading(TransferTask):
    r"""A character walks at a given speed in a direction that wanders.

    .. math:: \hat{\theta}_t = \hat{\theta}_{t-1} + \mathrm{Uniform}(-\delta, \delta)

    ``goal`` (2) is the unit vector of the target direction in the character's heading frame. The reward of a step
    uses the direction that the action could see.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        max_turn: Largest change :math:`\delta` of the direction per step, in radians. Paper: 0.15.
        speed: Target speed :math:`\hat{v}`, in m/s. Paper: 1.
        initial_directions: Range (lo, hi) of the first direction, in radians from the direction that the character
            faces. The paper does not say; its returns of 0.97 leave no time to turn round, hence the default.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``; 600 are 20 s.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.transfer.TransferTask`.

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
        not_negative(max_turn=max_turn)
        positive(speed=speed)
        self.max_turn, self.speed = max_turn, speed
        super().__init__(
            character,
            num_envs,
            ranges={"initial_directions": initial_directions},
            max_episode_steps=max_episode_steps,
            episode={"direction": torch.zeros((), dtype=torch.float64)},
            **kwargs,
        )
        self._make_specs()

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is the worst possible and 1 the best, :math:`\bar{R} = R / T`.

        :math:`R` is the undiscounted return and :math:`T` ``max_episode_steps``: a reward is at most 1. The paper's
        normalisation is not documented.
        """
        return episode_return / self.max_episode_steps

    def _goal_mirror(self) -> Mirror:
        return mirror_signs(VECTOR_SIGNS)

    def reach(self) -> Reach:
        """See :meth:`CharacterEnv.reach`: the ideal player walks at the target speed from the first step on."""
        still = torch.zeros(self.num_envs, 2, dtype=torch.float64, device=self.device)
        standing = heading_reward(still, unit_vector(self.episode["direction"]), self.speed)
        return Reach(self.max_episode_steps * standing, torch.full_like(standing, self.max_episode_steps))

    def _sample(self, num: int) -> dict[str, Tensor]:
        drawn = self.ranges.draw(num, self.generator)
        return {**super()._sample(num), "direction": drawn["initial_directions"]}

    def _show(self, ids: Tensor | slice) -> dict[str, Tensor]:
        angle = self.heading(ids)
        return {"observation": self._state(ids, angle), "goal": unit_vector(self.episode["direction"][ids] - angle)}

    def _rewards(self) -> Tensor:
        direction = self.episode["direction"]
        reward = heading_reward(self._com_velocity(), unit_vector(direction), self.speed)
        direction += torch.empty_like(direction).uniform_(-self.max_turn, self.max_turn, generator=self.generator)
        return reward.unsqueeze(0)

    def arrows(self, index: int) -> list[Arrow]:
        """See :meth:`CharacterEnv.arrows`: an arrow in the target direction."""
        tail = self._com[index].cpu() + torch.tensor([0.0, 0.0, 0.8])
        tip = tail + torch.nn.functional.pad(unit_vector(self.episode["direction"][index].cpu()), (0, 1))
        return [(tail.double().numpy(), tip.numpy())]


def unit_vector(angle: Tensor) -> Tensor:
    """(cos, sin) of an angle in radians, shape ``(*B, 2)``."""
    return torch.stack([angle.cos(), angle.sin()], -1)
