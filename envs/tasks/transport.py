"""The base class of carrying and dribbling: a character brings an object to a target."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from torchrl_mcp.adapters.contract import Reach
from torchrl_mcp.envs.characters.mirror import BODY_SIGNS, VECTOR_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.ideal import transport_reach
from torchrl_mcp.envs.observations import SIZES, UNITS
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.steering import Steerable, UserGoal
from torchrl_mcp.envs.tasks.objects import SceneObject
from torchrl_mcp.envs.tasks.places import ANY_DIRECTION, LOGARITHMIC, logarithmic, steps
from torchrl_mcp.envs.tasks.ranges import Ranges
from torchrl_mcp.envs.tasks.rewards import training_reward, transport_reward
from torchrl_mcp.values import Count, Positive, Range, Weights, checked

# Forms of the horizontal positions in a goal
Positions = Literal["metres", "logarithmic"]

POSITION_UNIT = f"{LOGARITHMIC}; height in m"
"""Unit of a logarithmic position of an object."""


class Transport(PDCharacterEnv):
    """A character brings an object to a target: the reward of appendix D, its variants, and what a return can reach.

    A subclass sets the class attributes below. Its constructor makes ``object`` and ``target`` with
    :meth:`begin_with`, and ends with :meth:`.CharacterEnv.make_specs`.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        object_distances: Range (lo, hi) of the object's distance from the character, in metres. The paper's range
            begins at 0; tasks raise lo until the object does not touch the character.
        object_directions: Range (lo, hi) of the direction of the object, in radians from the character's heading.
        target_distances: Range (lo, hi) of the target's distance from the object, in metres.
        target_directions: Range (lo, hi) of the direction from the object to the target, in radians from the direction
            of the object: 0 is straight beyond it.
        speed: Target speed of character and object, in m/s. Paper: 1.
        target_distance_power: Power of the distance between object and target in the reward: 2 (paper) or 1.
        success_reward: Whether the reward is 1 while successful.
        goal_positions: Form of the horizontal positions in ``goal``: ``"metres"``, or ``"logarithmic"``, see
            :func:`~torchrl_mcp.envs.tasks.places.logarithmic`. (A table is 0.3 m wide, which is less than a tenth in
            standardised metres.)
        waypoint: Whether the goal ends with the place where the character should go next, see
            :mod:`~torchrl_mcp.envs.tasks.waypoints`, in the form in which :class:`.Location` shows places.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``. The paper mentions thousands of steps;
            3000 steps are 100 s, as in the same authors' public code for a ball.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.
    """

    num_reward_terms = 4

    units: Mapping[str, str] = MappingProxyType({**UNITS, "waypoint": LOGARITHMIC})

    objects: ClassVar[Mapping[str, int]]
    """The objects in the order of the scene, and how many numbers the goal has for each of them."""

    weights: ClassVar[tuple[float, float, float, float]]
    """Weights of the four terms of :func:`~torchrl_mcp.envs.tasks.rewards.transport_reward`: the character's speed
    towards the object and its distance from the object, the object's speed towards the target and its distance from the
    target."""

    proximity_scale: ClassVar[float]
    """Scale of the distance between character and object in the reward, per square metre."""

    success_distance: ClassVar[float]
    """Distance in metres from the target at which an ideal player succeeds."""

    success_reach: ClassVar[float] = math.inf
    """Distance in metres from the object within which a player must be to succeed."""

    object: SceneObject
    target: SceneObject

    @checked
    def __init__(
        self,
        character: str,
        num_envs: Count,
        *,
        object_distances: Range = (0.0, 10.0),
        object_directions: Range = ANY_DIRECTION,
        target_distances: Range = (0.0, 10.0),
        target_directions: Range = ANY_DIRECTION,
        speed: Positive = 1.0,
        target_distance_power: Literal[1, 2] = 2,
        success_reward: bool = False,
        goal_positions: Positions = "metres",
        waypoint: bool = False,
        max_episode_steps: Count = 3000,
        **kwargs: Any,
    ) -> None:
        self.speed = speed
        self.target_distance_power = target_distance_power
        self.success_reward = success_reward
        self.goal_positions = goal_positions
        self.waypoint = waypoint
        self.goal_layout = goal_layout(self.objects, waypoint)
        if goal_positions == "logarithmic":
            self.units = {**self.units, **dict.fromkeys((f"{name}.position" for name in self.objects), POSITION_UNIT)}
        super().__init__(character, num_envs, max_episode_steps=max_episode_steps, **kwargs)
        ranges = {
            "object_distances": object_distances,
            "object_directions": object_directions,
            "target_distances": target_distances,
            "target_directions": target_directions,
        }
        self.ranges = Ranges(ranges, self.curriculum.mixture)
        self.ranges.require_distances("object_distances", "target_distances")

    def begin_with(self, object: str, target: str) -> None:
        """Look at the object and the target, bodies of the scene by name, and measure the object's velocity."""
        self.object = SceneObject(self.simulation, object)
        self.target = SceneObject(self.simulation, target)
        self.track(object=self.object.position)

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The character, with object and target at drawn places around it."""
        start = super().initial_state(num)
        drawn = self.ranges.draw(num, self.generator)
        direction = drawn["object_directions"]
        place = start["qpos"][:, :2] + steps(drawn["object_distances"], direction)
        self.object.put(start, place)
        self.target.put(start, place + steps(drawn["target_distances"], direction + drawn["target_directions"]))
        return start

    def goal(self, objects: Tensor, ids: Tensor | slice) -> Tensor:
        """Goal of simulations, laid out as ``goal_layout`` says, ``(n, G)``.

        Args:
            objects: What the characters see of M objects, ``(n, M, 13)``, see :meth:`.PDCharacterEnv.see`.
            ids: The simulations.
        """
        if self.goal_positions == "logarithmic":
            objects = torch.cat([logarithmic(objects[..., :2]), objects[..., 2:]], -1)
        parts = [objects[..., index, :size] for index, size in enumerate(self.objects.values())]
        if self.waypoint:
            parts.append(self.waypoint_seen(ids).to(objects.dtype))
        return torch.cat(parts, -1)

    @abstractmethod
    def waypoint_seen(self, ids: Tensor | slice) -> Tensor:
        """The place to go to next, as simulations see it, ``(n, 2)``."""

    @abstractmethod
    def success(self) -> Tensor:
        """Whether the object is where it should be, shape ``(N,)``, bool."""

    def reward(self) -> Tensor:
        """Reward of appendix D, or 1 while successful."""
        reward = self.reward_of(*self.motion())
        return reward.masked_fill(self.success(), 1.0) if self.success_reward else reward

    def reward_of(self, *motion: Tensor) -> Tensor:
        """Reward of appendix D of a motion, as :meth:`motion` describes one, ``(N,)``."""
        return self._terms(motion, self.weights, self.target_distance_power)

    def training_reward(self) -> Tensor:
        """See :func:`~torchrl_mcp.envs.tasks.rewards.training_reward`. The distance to the target is not squared."""
        weights = self.curriculum.reward_weights
        assert weights is not None
        reward = self._terms(self.motion(), weights, target_distance_power=1)
        worth = self.curriculum.success_worth
        return training_reward(reward, self.success(), weights=weights, speed=self.speed, worth=worth)

    def _terms(self, motion: tuple[Tensor, ...], weights: Weights, target_distance_power: int) -> Tensor:
        return transport_reward(
            *motion,
            weights=weights,
            proximity_scale=self.proximity_scale,
            speed=self.speed,
            target_distance_power=target_distance_power,
        )

    def motion(self) -> tuple[Tensor, ...]:
        """Horizontal centre of mass, its velocity, object, its velocity, and target, each ``(N, 2)``."""
        parts = (
            self.com,
            self.velocity("com"),
            self.object.position,
            self.velocity("object"),
            self.target.position,
        )
        return tuple(part[:, :2] for part in parts)

    def reach(self) -> Reach:
        """Returns of standing still, and of an ideal player that takes the object straight to its target."""
        com, _, place, _, target = self.motion()
        return transport_reach(
            self.reward_of,
            *(position.clone() for position in (com, place, target)),
            speed=self.speed,
            timestep=self.control_timestep,
            num_steps=self.max_episode_steps,
            success_distance=self.success_distance if self.success_reward else 0.0,
            success_reach=self.success_reach,
        )

    @property
    def steerable(self) -> Steerable:
        """See :attr:`.CharacterEnv.steerable`: the place of the target."""
        return Steerable(place=True)

    def steer(self, goal: UserGoal) -> None:
        """See :meth:`.CharacterEnv.steer`."""
        if goal.place is not None:
            self.target.next_position[0, :2] = self.target.position.new_tensor(goal.place)

    def goal_mirror(self) -> Mirror:
        """See :meth:`PDCharacterEnv.goal_mirror`."""
        signs = [sign for size in self.objects.values() for sign in BODY_SIGNS[:size]]
        return mirror_signs([*signs, *VECTOR_SIGNS] if self.waypoint else signs)

    def arrows(self, index: int) -> list[Arrow]:
        """Arrows from above the character to the object, and from above the object to the target."""
        place = self.object.position[index]
        return [pointer(self.com[index], place), pointer(place, self.target.position[index])]


def goal_layout(sizes: Mapping[str, int], waypoint: bool) -> dict[str, slice]:
    """Slices of the goal by object and quantity, from the number of entries of each object, and of the waypoint."""
    layout = {}
    start = 0
    for name, shown in sizes.items():
        end = start + shown
        for quantity, size in SIZES.items():
            if start < end:
                layout[f"{name}.{quantity}"] = slice(start, start + size)
                start += size
    return {**layout, "waypoint": slice(start, start + len(VECTOR_SIGNS))} if waypoint else layout


def pointer(tail: Tensor, tip: Tensor) -> Arrow:
    """Return a horizontal arrow above ``tail``, towards ``tip``, positions ``(3,)`` in metres, and at most 1 m long."""
    tail = tail.double().cpu()
    tip = tip.double().cpu()
    way = (tip - tail) * torch.tensor([1.0, 1.0, 0.0])
    start = tail + torch.tensor([0.0, 0.0, 0.8])
    return start.numpy(), (start + way / way.norm().clamp_min(1.0)).numpy()
