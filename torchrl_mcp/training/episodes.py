"""Measures returns and lengths of the episodes that end during training."""

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_mcp.adapters.contract import task_reward


class EpisodeStatistics:
    """Returns and lengths of episodes that span several batches, from the task's own rewards.

    Args:
        num_envs: Number of environments, ``N``.

    Attributes:
        steps: Steps so far in each environment. While this number is below the longest episode, only episodes that end
            early have ended, and the mean of their returns differs from the mean of all episodes.
    """

    def __init__(self, num_envs: int) -> None:
        self.steps: float = 0
        self.returns = torch.zeros(num_envs)
        self.lengths = torch.zeros(num_envs)

    def update(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Add trajectories ``(N, T)``; return the return and length of each of the ``E`` ended episodes, ``(E,)``."""
        ended_returns = []
        ended_lengths = []
        self.steps += batch.shape[1]
        rewards = task_reward(batch["next"]).squeeze(-1).cpu()
        dones = batch["next", "done"].squeeze(-1).cpu()
        for reward, done in zip(rewards.unbind(1), dones.unbind(1), strict=True):
            self.returns += reward
            self.lengths += 1
            ended_returns.append(self.returns[done])
            ended_lengths.append(self.lengths[done])
            self.returns[done] = 0
            self.lengths[done] = 0
        return torch.cat(ended_returns), torch.cat(ended_lengths)

    def state_dict(self) -> dict[str, Any]:
        """Return the steps, and returns and lengths so far of the unfinished episodes, ``(N,)``."""
        return {"steps": self.steps, "returns": self.returns, "lengths": self.lengths}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`; the states of older versions lack the steps."""
        self.steps = state.get("steps", math.inf)
        self.returns = state["returns"].clone()
        self.lengths = state["lengths"].clone()
