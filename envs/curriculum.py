"""Curricula: how training episodes differ from the episodes of a task."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, TypedDict

from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.values import NotNegative, Positive, Range, Weights, require, types_of


class Weighted(TypedDict, total=False):
    """The weight of an alternative."""

    weight: Positive


# Ranges of a task by name, and a weight
Alternative = Annotated[Mapping[str, Any], Weighted, Mapping[str, Range]]


@dataclass(frozen=True)
class Curriculum:
    """How training episodes differ from the episodes of a task. By default they do not differ.

    Episodes may begin in motion or in easier situations. Training may use another reward, which the tasks describe. The
    environment then returns the task's own reward as ``task_reward`` ``(N, 1)`` beside ``reward``.

    Args:
        initial_states: ``"rest"``, ``"motions"`` or a weight for each, see
            :class:`~torchrl_mcp.envs.initial_states.InitialStates`.
        motions: Motions for initial states; None for the generated motions of the character.
        mixture: Alternatives to the task's ranges, see :class:`~torchrl_mcp.envs.tasks.ranges.Ranges`.
        reward_weights: Weights of the terms of the reward in training; None to train with the task's own reward.
        success_worth: Worth of a step in success in carrying or dribbling with ``reward_weights``, as a multiple of the
            best reward that a step without success can have.
        random_first_length: Whether to shorten the first episodes by different lengths, spread evenly over the
            simulations. Then simulations are at different times of their episodes; otherwise a batch of short
            trajectories would cover a single time.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        Half of the episodes begin in motion, and their first lengths differ.

        >>> from torchrl_mcp.envs import Curriculum, Heading
        >>> curriculum = Curriculum(initial_states={"rest": 0.5, "motions": 0.5}, random_first_length=True)
        >>> env = Heading("biped", num_envs=4, curriculum=curriculum, seed=0)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([4, 3, 1])
    """

    initial_states: Literal["rest", "motions"] | Mapping[str, NotNegative] = "rest"
    motions: MotionLibrary | Mapping[str, MotionClip] | None = None
    mixture: Sequence[Alternative] = ()
    reward_weights: Weights | None = None
    success_worth: Positive = 1
    random_first_length: bool = False

    def __post_init__(self) -> None:
        for name, annotation in types_of(Curriculum.__init__).items():
            require(name, getattr(self, name), annotation)

    @classmethod
    def of(cls, given: "Curriculum | Mapping[str, Any] | None") -> "Curriculum":
        """Return a curriculum as it is, or make one from its arguments by name, or from None, which changes nothing.

        Raises:
            ValueError: If ``given`` is of another type, or a name is unknown.
        """
        if isinstance(given, Curriculum):
            return given
        known = ", ".join(field.name for field in fields(cls))
        if not isinstance(given, Mapping | None):
            raise ValueError(f"curriculum={given} must be null, or some of these settings by name: {known}")
        arguments = dict(given or {})
        if unknown := arguments.keys() - {field.name for field in fields(cls)}:
            raise ValueError(f"curriculum names {sorted(unknown)}: pass some of {known}")
        return cls(**arguments)
