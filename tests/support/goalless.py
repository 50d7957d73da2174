"""Environments without a goal."""

from torchrl_mcp.envs import Holdout


class Runner(Holdout):
    """An ant that runs ahead, and is told nothing of it."""

    goal_layout = {}  # noqa: RUF012

    def __init__(self, num_envs, directions=(0.0, 0.0), **kwargs):
        super().__init__(num_envs, directions, **kwargs)

    def observe(self, ids):
        return {"observation": super().observe(ids)["observation"]}


class EmptyGoal(Runner):
    """The same, with a goal of no entries."""

    def observe(self, ids):
        observed = super().observe(ids)
        return {**observed, "goal": observed["observation"][:, :0]}
