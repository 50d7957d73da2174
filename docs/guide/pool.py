"""EnvPool's environments of Gymnasium's tasks, which step side by side in threads."""

import envpool
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase


class Pool(EnvBase):
    """Environments of one of EnvPool's tasks.

    Args:
        task: Name of the task.
        num_envs: Number of environments.
        seed: Seed of the first environment.
    """

    def __init__(self, task: str, num_envs: int, seed: int = 0) -> None:
        super().__init__(batch_size=[num_envs])
        self.task = task
        self.set_seed(seed)
        actions = self.pool.action_space
        one = (num_envs, 1)
        flags = {name: Binary(1, shape=one, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.max_episode_steps = self.pool.config["max_episode_steps"]
        self.observation_spec = Composite(observation=Unbounded(self.observed.shape), shape=self.batch_size)
        self.action_spec = Bounded(float(actions.low.min()), float(actions.high.max()), (num_envs, *actions.shape))
        self.reward_spec = Unbounded(one)
        self.full_done_spec = Composite(flags, shape=self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ended = torch.ones(self.batch_size, dtype=torch.bool) if mask is None else mask.squeeze(-1)
        observed, _ = self.pool.reset(ended.nonzero().squeeze(-1).numpy())
        self.observed[ended] = torch.as_tensor(observed).float()
        return TensorDict(observation=self.observed.clone(), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observed, rewards, terminations, truncations, _ = self.pool.step(tensordict["action"].double().numpy())
        self.observed = torch.as_tensor(observed).float()
        reward = torch.as_tensor(rewards).unsqueeze(-1)
        terminated = torch.as_tensor(terminations).unsqueeze(-1)
        truncated = torch.as_tensor(truncations).unsqueeze(-1)
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict(ends, batch_size=self.batch_size).update(
            {"observation": self.observed.clone(), "reward": reward.float()}
        )

    def _set_seed(self, seed: int | None) -> None:
        """Make the environments, which take a seed at no other time."""
        self.pool = envpool.make_gymnasium(self.task, num_envs=self.batch_size[0], seed=seed or 0)
        self.observed = torch.zeros(*self.batch_size, *self.pool.observation_space.shape)
