"""The base class of tasks for pre-trained characters: aids for training."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mcp.envs.beginnings import Beginnings
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.ranges import Ranges

TASK_REWARD = "task_reward"
"""Key of the task's own reward in environments that train on another reward."""


def task_reward(outcome: TensorDictBase) -> Tensor:
    """The task's own reward of steps, also if training uses another, ``(*B, 1)``.

    Args:
        outcome: Output of an environment's steps, batch size ``(*B,)``.
    """
    return outcome.get(TASK_REWARD, outcome["reward"])


class TransferTask(PDCharacterEnv):
    """A task for characters that can walk, with aids for training that are off by default.

    Episodes may begin in motion, and in easier situations than those of the task. Training may use another reward;
    ``task_reward`` (1) is then the task's own, beside ``reward``.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        ranges: Intervals of the quantities that are drawn uniformly for each episode, by name.
        mixture: Alternatives to ``ranges``, see :class:`~torchrl_mcp.envs.ranges.Ranges`.
        initial_states: ``"rest"``, ``"motions"`` or a weight for each, see
            :class:`~torchrl_mcp.envs.beginnings.Beginnings`.
        motions: Motions for initial states, None for the generated ones.
        discount: Discount factor of the learner.
        staggered: Shorten the first episodes by different lengths, so that simulations are at different times of their
            episodes: otherwise a batch of short trajectories would cover a single time.
        practised: Whether training uses another reward than the task's.
        episode: Initial task state of one simulation.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        ranges: Mapping[str, Sequence[float]],
        mixture: Sequence[Mapping[str, Any]] = (),
        initial_states: str | Mapping[str, float] = "rest",
        motions: MotionLibrary | Mapping[str, MotionClip] | None = None,
        discount: float = 0.99,
        staggered: bool = False,
        practised: bool = False,
        episode: Mapping[str, Tensor],
        **kwargs: Any,
    ) -> None:
        self.ranges = Ranges(ranges, mixture)
        if not 0 < discount <= 1:
            raise ValueError(f"discount={discount} is out of range: pass the learner's, above 0 and at most 1")
        self.discount, self.staggered, self._practised = discount, staggered, practised
        remembered = {TASK_REWARD: torch.zeros((), dtype=torch.float64)} if practised else {}
        super().__init__(character, num_envs, episode={**remembered, **episode}, **kwargs)
        self.ranges.to(self.device)
        self.beginnings = Beginnings(character, initial_states, motions, self.device)

    def _sample(self, num: int) -> dict[str, Tensor]:
        start = super()._sample(num)
        qpos, qvel = self.beginnings.draw(num, self.generator)
        start["qpos"][:, : qpos.shape[1]], start["qvel"][:, : qvel.shape[1]] = qpos, qvel
        return start

    def _begin(self, ids: Tensor) -> dict[str, Tensor]:
        begun = super()._begin(ids)
        if self._practised:
            begun[TASK_REWARD] = torch.zeros_like(self.episode[TASK_REWARD][ids])
        if self.staggered and len(ids) == self.num_envs:
            begun["elapsed_steps"] = (ids * self.max_episode_steps // self.num_envs).unsqueeze(-1)
        return begun

    def _observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        observed = self._show(ids)
        if self._practised:
            observed[TASK_REWARD] = self.episode[TASK_REWARD][ids].unsqueeze(-1)
        return observed

    def _reward_and_termination(self, diverged: Tensor) -> tuple[Tensor, Tensor]:
        rewards, terminated = self._unless_fallen(self._rewards())
        if self._practised:
            self.episode[TASK_REWARD].copy_(rewards[0])[diverged] = 0.0
        return rewards[-1], terminated

    @abstractmethod
    def _show(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """See :meth:`CharacterEnv._observe`."""

    @abstractmethod
    def _rewards(self) -> Tensor:
        """Rewards of the last step, unless the character has fallen, float64; updates ``episode``.

        The task's own, ``(1, N)``, or the task's own and the one for training, ``(2, N)``.
        """
