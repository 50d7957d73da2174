"""Gymnasium's HalfCheetah at a target speed, which is the goal of the episode."""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.spaces import Box, Dict, Discrete

Observation = dict[str, Any]


class CheetahSpeeds(HalfCheetahEnv):
    """HalfCheetah that runs at one of several speeds, drawn for each episode.

    The reward of a step is 1 at the target speed and falls to 0 at standing still and at twice the speed.

    Args:
        speeds: Target speeds in m/s.
        **kwargs: Passed on to Gymnasium's environment.
    """

    def __init__(self, speeds: Sequence[float], **kwargs: Any) -> None:
        super().__init__(camera_name="track", **kwargs)
        self.speeds = list(speeds)
        self.number = 0
        self.observation_space = Dict(
            observation=self.observation_space,
            desired_goal=Box(0.0, np.inf, (1,), np.float64),
            number=Discrete(len(self.speeds)),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw a speed, and begin an episode."""
        observation, info = super().reset(seed=seed, options=options)
        self.number = int(self.np_random.integers(len(self.speeds)))
        return self._observed(observation), info

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take an action."""
        observation, _, terminated, truncated, info = super().step(action)
        speed = self.speeds[self.number]
        error = abs(info["x_velocity"] - speed)
        reward = max(0.0, 1.0 - error / speed)
        return self._observed(observation), reward, terminated, truncated, {"speed_error": error}

    def _observed(self, observation: np.ndarray) -> Observation:
        goal = np.array([self.speeds[self.number]])
        return {"observation": observation, "desired_goal": goal, "number": self.number}


gymnasium.register("CheetahSpeeds-v0", entry_point=CheetahSpeeds, max_episode_steps=200)
