"""What the tasks of carrying and dribbling share."""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar

from torch import Tensor

from torchrl_mcp.envs.characters.mirror import Mirror
from torchrl_mcp.envs.ideal import Reach, transport_reach
from torchrl_mcp.envs.observations import UNITS
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.tasks.rewards import training_reward
from torchrl_mcp.envs.tasks.transport import (
    LOGARITHMIC,
    POSITION_UNIT,
    goal_layout,
    goal_mirror,
    pointers,
    require_transport,
)


class Transport(PDCharacterEnv):
    """A character brings an object to a target: the reward of appendix D, its variants, and what a return can reach.

    A subclass has the class attributes below, keeps live views of the positions of object and target, each ``(N, 3)``,
    in ``_object`` and ``_target``, and tracks the object as ``object``.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        speed: Target speed of character and object, in m/s. Paper: 1.
        target_distance_power: Power of the distance between object and target in the reward: 2 (paper) or 1.
        success_reward: Set the reward to 1 while successful.
        goal_positions: Form of the horizontal positions in ``goal``: ``"metres"``, or ``"logarithmic"``, see
            :func:`~torchrl_mcp.envs.tasks.transport.logarithmic`. A table is 0.3 m wide, and in standardised metres
            this is less than a tenth.
        waypoint: End the goal with the place where the character should go next, see
            :mod:`~torchrl_mcp.envs.tasks.waypoints`, as :class:`.Location` shows places.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.
    """

    num_reward_terms = 4

    units: Mapping[str, str] = MappingProxyType({**UNITS, "waypoint": LOGARITHMIC})

    objects: ClassVar[Mapping[str, int]]
    """The objects in the order of the scene, and how many numbers the goal has of each."""

    reward_of: ClassVar[Callable[..., Tensor]]
    """The reward, :func:`~torchrl_mcp.envs.tasks.rewards.transport_reward` with the task's weights and scales."""

    success_distance: ClassVar[float]
    """Distance in metres from the target at which an ideal player succeeds."""

    success_reach: ClassVar[float] = math.inf
    """Distance in metres from the object within which a player must be to succeed."""

    _object: Tensor
    _target: Tensor

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        speed: float = 1.0,
        target_distance_power: float = 2,
        success_reward: bool = False,
        goal_positions: str = "metres",
        waypoint: bool = False,
        **kwargs: Any,
    ) -> None:
        require_transport(speed=speed, target_distance_power=target_distance_power, goal_positions=goal_positions)
        self.speed, self.target_distance_power, self.success_reward = speed, target_distance_power, success_reward
        self.goal_positions, self.waypoint = goal_positions, waypoint
        self.goal_layout = goal_layout(self.objects, waypoint)
        if goal_positions == "logarithmic":
            self.units = {**self.units, **dict.fromkeys((f"{name}.position" for name in self.objects), POSITION_UNIT)}
        super().__init__(character, num_envs, **kwargs)

    @abstractmethod
    def success(self) -> Tensor:
        """Whether the object is where it should be, shape ``(N,)``, bool."""

    def reward(self) -> Tensor:
        """Reward of appendix D, or 1 while successful."""
        reward = self.reward_of(*self._motion(), speed=self.speed, target_distance_power=self.target_distance_power)
        return reward.masked_fill(self.success(), 1.0) if self.success_reward else reward

    def training_reward(self) -> Tensor:
        """See :func:`~torchrl_mcp.envs.tasks.rewards.training_reward`."""
        aids, weights = self.curriculum, self.curriculum.reward_weights
        assert weights is not None
        power, speed = aids.target_distance_power, self.speed
        reward = self.reward_of(*self._motion(), weights=weights, speed=speed, target_distance_power=power)
        return training_reward(reward, self.success(), weights=weights, speed=speed, discount=aids.discount)

    def terminated(self) -> Tensor:
        """A success, if it ends the episode."""
        return self.success() if self.curriculum.ends_at_success else super().terminated()

    def reach(self) -> Reach:
        """Returns of standing still, and of an ideal player that takes the object straight to its target."""
        com, _, place, _, target = self._motion()
        return transport_reach(
            partial(self.reward_of, speed=self.speed, target_distance_power=self.target_distance_power),
            *(position.clone() for position in (com, place, target)),
            speed=self.speed,
            timestep=self.control_timestep,
            num_steps=self.max_episode_steps,
            success_distance=self.success_distance if self.success_reward else 0.0,
            success_reach=self.success_reach,
        )

    def goal_mirror(self) -> Mirror:
        """See :meth:`PDCharacterEnv.goal_mirror`."""
        return goal_mirror(self.objects, self.waypoint)

    def arrows(self, index: int) -> list[Arrow]:
        """Arrows from above the character to the object, and from above the object to the target."""
        return pointers(self.com[index], self._object[index], self._target[index])

    def _motion(self) -> tuple[Tensor, ...]:
        """Horizontal centre of mass, its velocity, object, its velocity, and target, each ``(N, 2)``."""
        parts = (self.com, self.velocity("com"), self._object, self.velocity("object"), self._target)
        return tuple(part[:, :2] for part in parts)
