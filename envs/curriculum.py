"""Curricula: how training episodes differ from the episodes of a task."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, TypedDict

from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.values import NotNegative, Positive, Range, Share, Weights, require, types_of


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
        after_success: What a success in carrying or dribbling does to a training episode with ``reward_weights``.
            ``"end"``: the success ends the episode, and is worth the reward for succeeding for ever.
            ``"continue"``: the episode continues, and every step in success earns its share of that reward, so that the
            character learns to leave the object at the target. ``"staged"``: successes end episodes until more than a
            quarter of the recent episodes have succeeded; from then on, episodes continue. See
            :class:`~torchrl_mcp.envs.curriculum.SuccessShare`.
        success_worth: Worth of a step in success with ``reward_weights``, as a multiple of the best reward that a step
            without success can have.
        target_distance_power: Power of the distance to the target in a reward with ``reward_weights``.
        random_first_length: Whether to shorten the first episodes by different lengths, spread evenly over the
            simulations. Then simulations are at different times of their episodes; otherwise a batch of short
            trajectories would cover a single time.
        discount: Discount factor of the learner, which determines the worth of a success that ends the episode.

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
    after_success: Literal["end", "continue", "staged"] = "end"
    success_worth: Positive = 1
    target_distance_power: NotNegative = 1
    random_first_length: bool = False
    discount: Share = 0.99

    def __post_init__(self) -> None:
        for name, annotation in types_of(Curriculum.__init__).items():
            require(name, getattr(self, name), annotation)
        if self.discount == 0:
            raise ValueError("discount=0 is out of range: pass the discount of the learner, which is above 0")
        if self.reward_weights is not None and self.discount == 1:
            raise ValueError(
                "reward_weights with discount=1 make a success worth infinite reward: pass a discount below 1"
            )

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


class SuccessShare:
    """The share of recent training episodes that succeeded, for the curriculum ``after_success="staged"``.

    The share is a mean over all episodes, in which the weight of an episode falls by a factor of e with each 1000 later
    episodes. The share begins at 0. With ``collector=processes`` or ``ray``, every worker counts its own episodes, and
    begins again when the run is resumed.

    Attributes:
        share: The share.
        was_reached: Whether the share has exceeded ``ENOUGH`` so far.
    """

    EPISODES = 1000
    """Number of episodes after which the weight of an episode has fallen by a factor of e."""

    ENOUGH = 0.25
    """Share above which training episodes continue after a success."""

    def __init__(self) -> None:
        self.share = 0.0
        self.was_reached = False

    def count(self, episodes: int, successes: int) -> None:
        """Add episodes that have ended, of which some have succeeded."""
        weight = -math.expm1(-episodes / self.EPISODES)
        self.share += weight * (successes / episodes - self.share)
        self.was_reached |= self.share > self.ENOUGH
