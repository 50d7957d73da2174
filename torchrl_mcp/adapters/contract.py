"""What training, evaluation and export need of environments: TorchRL's ``EnvBase``, and a few more members."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

TASK_REWARD = "task_reward"
"""Key of the task's own reward in environments that train with another reward."""


class Reach(NamedTuple):
    """Two returns with which the returns of a learner are compared.

    They are not bounds. A player that falls earns less than a player that stands still, and moving an object to and fro
    at its target earns a little more than leaving it there.

    Args:
        standing: Return of a player that stands still without falling, ``(N,)``.
        ideal: Return of a player that goes where the task leads at its speed, and rests there, ``(N,)``.
    """

    standing: Tensor
    ideal: Tensor

    def skill(self, returns: Tensor) -> Tensor:
        """Skill score of the mean of returns, ``()``: 0 for standing still, 1 for the ideal player."""
        standing = self.standing.mean()
        return (returns.mean() - standing) / (self.ideal.mean() - standing)


def entry_names(sizes: Mapping[str, int]) -> dict[str, list[str]]:
    """Return names for the entries of each vector of a given size: its key, which is numbered if there are several.

    >>> entry_names({"success": 1, "force": 2})
    {'success': ['success'], 'force': ['force_0', 'force_1']}
    """
    return {key: [key] if size == 1 else [f"{key}_{i}" for i in range(size)] for key, size in sizes.items()}


class Environments(Protocol):
    """N environments side by side, a TorchRL ``EnvBase`` with batch size ``[N]``.

    | key | content | shape |
    |---|---|---|
    | ``observation``, ``goal`` | state and goal, floating point | ``(N, S)``, ``(N, G)`` |
    | ``action`` | from -1 to 1 | ``(N, A)`` |
    | ``reward``, ``terminated``, ``truncated``, ``done`` | of the step | ``(N, 1)`` |
    | ``goal_number`` | optional: number of the goal, below ``num_goals``, for ``method=hierarchical`` | ``(N,)`` |
    | ``task_reward`` | optional: the task's own reward, if training uses another reward | ``(N, 1)`` |

    The environments of this library satisfy this contract, and :class:`~torchrl_mcp.adapters.adapter.Adapter` adds what
    other environments lack. :func:`~torchrl_mcp.adapters.check.require_contract` checks the contract.

    Attributes:
        max_episode_steps: Number of steps after which an episode is ``truncated``.
        control_timestep: Seconds from one action to the next.
        metric_names: Observations that are metrics and not inputs of the policy, ``(N, E)`` by key: flags (bool) or
            numbers, with the names of their entries.
        num_diverged: Number of episodes so far that ended because their simulation diverged.
        goal_layout: Slices of ``goal`` by name, in order; empty if the entries have no names.
        resumes_episodes: Whether ``state_dict`` contains the state of all episodes, so that a resumed run continues
            them to the same numbers; otherwise it begins new episodes.
    """

    max_episode_steps: int
    control_timestep: float
    num_diverged: int
    goal_layout: Mapping[str, slice]
    resumes_episodes: bool

    @property
    def metric_names(self) -> dict[str, list[str]]:
        """See the class."""
        ...

    @property
    def physics_seconds(self) -> float:
        """Wall-clock seconds that the simulation itself has taken so far."""
        ...

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        """Return undiscounted returns on the scale of reports, where 0 is bad and 1 is good, in the same shape."""
        ...

    def reach(self) -> Reach | None:
        """Returns of standing still and of an ideal player in the present episodes, or None if they are unknown."""
        ...

    def mirrors(self) -> Mapping[str, nn.Module]:
        """Reflections that exchange left and right in ``observation``, ``goal`` and ``action``.

        Raises:
            ValueError: If the environments have no mirror images.
        """
        ...

    # Of EnvBase: the rest of what is called
    batch_size: torch.Size
    device: torch.device
    observation_spec: Composite
    action_spec: TensorSpec

    def reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Begin episodes."""
        ...

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and begin new episodes after ended ones."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """State for :meth:`load_state_dict`, without pickled code."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> object:
        """Restore the state."""
        ...

    def close(self) -> object:
        """Release the resources of the environments."""
        ...


def task_reward(outcome: TensorDictBase) -> Tensor:
    """The task's own reward of steps, ``(*B, 1)``, even if training uses another reward.

    Args:
        outcome: Output of an environment's steps, batch size ``(*B,)``.
    """
    return outcome.get(TASK_REWARD, outcome["reward"])
