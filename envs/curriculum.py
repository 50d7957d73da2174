"""Aids for training: how its episodes differ from those of a task."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary


@dataclass(frozen=True)
class Curriculum:
    """How training episodes differ from those of a task; by default, they do not.

    Episodes may begin in motion, and in easier situations. Training may use another reward, as tasks say; the output
    then has the task's own as ``task_reward`` (1) beside ``reward``.

    Args:
        initial_states: ``"rest"``, ``"motions"`` or a weight for each, see
            :class:`~torchrl_mcp.envs.initial_states.InitialStates`.
        motions: Motions for initial states, None for the character's generated ones.
        mixture: Alternatives to the task's ranges, see :class:`~torchrl_mcp.envs.tasks.ranges.Ranges`.
        reward_weights: Weights of the terms of the reward for training; None to train with the task's own reward.
        target_distance_power: Power of the distance to the target in the reward with other weights.
        random_first_length: Shorten the first episodes by different lengths, evenly spread over the simulations, so
            that these are at different times of their episodes: otherwise a batch of short trajectories would cover a
            single time.
        discount: Discount factor of the learner, for the worth of a success, which ends the episode.

    Raises:
        ValueError: If the discount is out of range.
    """

    initial_states: str | Mapping[str, float] = "rest"
    motions: MotionLibrary | Mapping[str, MotionClip] | None = None
    mixture: Sequence[Mapping[str, Any]] = ()
    reward_weights: Sequence[float] | None = None
    target_distance_power: float = 1
    random_first_length: bool = False
    discount: float = 0.99

    def __post_init__(self) -> None:
        if not 0 < self.discount <= 1:
            raise ValueError(f"discount={self.discount} is out of range: pass the learner's, above 0 and at most 1")
        if self.reward_weights is not None and self.discount == 1:
            raise ValueError(
                "reward_weights with discount=1: a success is worth full reward for ever, pass a discount below 1"
            )

    @property
    def ends_at_success(self) -> bool:
        """Whether a success ends an episode of carrying or dribbling."""
        return self.reward_weights is not None

    @classmethod
    def of(cls, given: "Curriculum | Mapping[str, Any] | None") -> "Curriculum":
        """Return a curriculum, also from its arguments by name, or from None for the task's own episodes.

        Raises:
            ValueError: If it is none of these, or a name is unknown.
        """
        if isinstance(given, Curriculum):
            return given
        known = ", ".join(field.name for field in fields(cls))
        if not isinstance(given, Mapping | None):
            raise ValueError(f"curriculum={given} is not a curriculum: pass null for none, or some of {known} by name")
        arguments = dict(given or {})
        if unknown := arguments.keys() - {field.name for field in fields(cls)}:
            raise ValueError(f"curriculum names {sorted(unknown)}: pass some of {known}")
        return cls(**arguments)
