"""Tasks of the DeepMind Control Suite side by side: walkers that stand, walk and run."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from tensordict import TensorDictBase
from torch.nn.functional import one_hot
from torchrl.data import Bounded, Composite
from torchrl.envs import CatTensors, Compose, DMControlEnv, EnvBase, SerialEnv, Transform, TransformedEnv

TASKS = ("stand", "walk", "run")


class Walkers(SerialEnv):
    """Walkers side by side, each of which has one task."""

    max_episode_steps = 1000

    def render(self, index: int = 0) -> np.ndarray:
        """Draw a walker, for films."""
        return self.physics[index].render(height=240, width=320, camera_id=0)


class TaskAsGoal(Transform):
    """The task in one-hot encoding, as ``goal``."""

    def __init__(self, task: str) -> None:
        super().__init__(out_keys=["goal"])
        self.goal = one_hot(torch.tensor(TASKS.index(task)), len(TASKS)).float()

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("goal", self.goal)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the goal."""
        observation_spec["goal"] = Bounded(0.0, 1.0, (len(TASKS),))
        return observation_spec


def walker(task: str) -> EnvBase:
    """Make a walker with a task."""
    state = CatTensors(["orientations", "height", "velocity"], "observation", sort=False)
    return TransformedEnv(DMControlEnv("walker", task), Compose(state, TaskAsGoal(task)))


def make(num_envs: int, tasks: Sequence[str]) -> EnvBase:
    """Make walkers, to which the tasks are dealt in turn."""
    return Walkers(num_envs, [partial(walker, tasks[number % len(tasks)]) for number in range(num_envs)])
