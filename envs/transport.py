"""The base class of carrying and dribbling: an object, a target, and the way between them."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.arguments import interval, not_negative
from torchrl_mcp.envs.motions.kinematics import BodyStates
from torchrl_mcp.envs.observations import bodies_in_heading_frame
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rendering import Arrow

SUCCESS_DISTANCE = 0.5
"""Metres between object and target from which the task counts as done; so in the same authors' public code."""


class Transport(PDCharacterEnv):
    """A character moves an object to a target; distances and directions are drawn uniformly for each episode.

    ``goal`` shows the things of the scene in the character's heading frame, positions relative to the root;
    ``goal_layout`` names its entries. ``success`` (1, bool) says whether the object is now at the target, that is,
    horizontally within 0.5 m.

    The reward is by default as printed in the paper. Two variants of the same authors' public code may be switched on:
    the plain distance to the target, which unlike its square still says something at 10 m, and every term 1 while
    successful. What lies at the target does not move, for which the printed reward is at most 0.73; with the second
    variant it is 1.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        things: Bodies that ``furnish`` adds, in this order, the target first and the object last, and how many numbers
            of each the goal shows: of its position (3), orientation (4), linear (3) and angular velocity (3).
        furnish: Adds these bodies to the scene: the object with 7 coordinates and 6 velocities, the others as mocap
            bodies.
        reward: :func:`~torchrl_mcp.envs.rewards.transport_reward` with the task's constants.
        object_distances: Range (lo, hi) of the object's distance from the character, in metres; lo is raised to where
            they do not overlap.
        target_distances: Range (lo, hi) of the target's distance from the object, in metres.
        speed: Target speed of character and object, in m/s. Paper: 1.
        target_distance_power: Power of the distance between object and target in the reward: 2 (paper) or 1.
        success_reward: Give the reward 1 while successful.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``. The paper speaks of thousands of steps;
            3000 are 100 s, as in the same authors' public code for a ball.
        episode: What the task remembers beside the object's position.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.
    """

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        things: Mapping[str, int],
        furnish: Callable[[mujoco.MjSpec], None],
        reward: Callable[..., Tensor],
        object_distances: Sequence[float] = (0.0, 10.0),
        target_distances: Sequence[float] = (0.0, 10.0),
        speed: float = 1.0,
        target_distance_power: float = 2,
        success_reward: bool = False,
        max_episode_steps: int = 3000,
        episode: Mapping[str, Tensor] | None = None,
        **kwargs: Any,
    ) -> None:
        not_negative(speed=speed)
        if target_distance_power not in (1, 2):
            raise ValueError(f"target_distance_power={target_distance_power} is out of range: pass 2 (paper) or 1")
        self.object_distances = distance_range("object_distances", object_distances)
        self.target_distances = distance_range("target_distances", target_distances)
        self.success_reward = success_reward
        self.goal_layout = goal_layout(things)
        """Where to find each quantity in ``goal``, by name."""
        self._shown = dict(things)
        self._reward = partial(reward, speed=speed, target_distance_power=target_distance_power)
        super().__init__(
            character,
            num_envs,
            max_episode_steps=max_episode_steps,
            episode={"object": torch.zeros(3, dtype=torch.float64), **(episode or {})},
            furnish=furnish,
            **kwargs,
        )
        # Live views, made once. The things follow the character's bodies.
        rows, outputs = slice(1 + len(self._bodies), None), self.simulation.outputs
        angular, linear = outputs["cvel"][:, rows].split(3, -1)
        self._things = BodyStates(outputs["xpos"][:, rows], outputs["xquat"][:, rows], linear, angular)
        self._look_at(slice(1, None))  # seen together, they take little longer than the character alone
        self._target, self._object = self._things.positions[:, 0], self._things.positions[:, -1]

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is the worst possible and 1 the best, :math:`\bar{R} = R / T`.

        :math:`R` is the undiscounted return and :math:`T` ``max_episode_steps``: a reward is at most 1. The paper's
        normalisation is not documented.
        """
        return episode_return / self.max_episode_steps

    def success(self) -> Tensor:
        """Whether the object is at the target, shape ``(N,)``, bool."""
        return torch.linalg.vector_norm((self._object - self._target)[:, :2], dim=-1) < SUCCESS_DISTANCE

    def _extent(self, low: float, high: float) -> float:
        """Furthest that the character's rest pose extends from its root between two heights, all in metres."""
        return horizontal_extent(self.simulation.model, len(self._bodies), low, high)

    def _sample(self, num: int) -> dict[str, Tensor]:
        start = super()._sample(num)
        marks = mocap_positions(self.simulation.model).repeat(num, 1, 1)
        place = start["qpos"][:, :2] + self._somewhere(num, self.object_distances)
        start["qpos"][:, -7:-5] = place
        marks[:, 0, :2] = place + self._somewhere(num, self.target_distances)
        return {**start, "mocap_pos": marks}

    def _somewhere(self, num: int, distances: tuple[float, float]) -> Tensor:
        """Draw steps in any direction, ``(num, 2)``."""
        distance, angle = torch.rand(2, num, dtype=torch.float64, generator=self.generator)
        low, high = distances
        return torch.polar(low + (high - low) * distance, 2 * math.pi * angle).view(torch.float64).view(num, 2)

    def _begin(self, ids: Tensor) -> dict[str, Tensor]:
        return {**super()._begin(ids), "object": self._object[ids]}

    def _observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        bodies = self._body_states(ids)
        root, angle = bodies.positions[:, 0], self.heading(ids).to(self._dtype)
        seen = bodies_in_heading_frame(angle, root, bodies).unflatten(-1, (-1, 13))
        own, things = seen.split([len(self._bodies), len(self._shown)], 1)
        shown = [things[:, index, :size] for index, size in enumerate(self._shown.values())]
        return {
            "observation": torch.cat([root[:, 2:], own.flatten(1)], -1),
            "goal": torch.cat(shown, -1),
            "success": self.success()[ids].unsqueeze(-1),
        }

    def _reward_and_termination(self, diverged: Tensor) -> tuple[Tensor, Tensor]:
        object_velocity = (self._object - self.episode["object"]) / self.control_timestep
        self.episode["object"].copy_(self._object)
        reward = self._reward(
            self._com[:, :2],
            self._com_velocity(),
            self._object[:, :2],
            object_velocity[:, :2],
            self._target[:, :2],
        )
        if self.success_reward:
            reward = reward.masked_fill(self.success(), 1.0)
        return self._unless_fallen(reward)

    def _arrows(self, index: int) -> list[Arrow]:
        """From above the character to the object, and from above the object to the target."""
        return [
            pointer(self._com[index], self._object[index]),
            pointer(self._object[index], self._target[index]),
        ]


def goal_layout(things: Mapping[str, int]) -> dict[str, slice]:
    """Where to find each quantity of things in the goal, of which each shows as many numbers."""
    sizes = {"position": 3, "orientation": 4, "linear_velocity": 3, "angular_velocity": 3}
    layout, start = {}, 0
    for thing, shown in things.items():
        end = start + shown
        for quantity, size in sizes.items():
            if start < end:
                layout[f"{thing}.{quantity}"] = slice(start, start + size)
                start += size
    return layout


def distance_range(name: str, value: Sequence[float]) -> tuple[float, float]:
    """Check that ``value`` is a range of distances, and return it."""
    low, high = interval(name, value)
    if low < 0:
        raise ValueError(f"{name}={value!r} begins below 0: pass two distances (lo, hi) in metres")
    return low, high


def clear_of(name: str, value: tuple[float, float], clearance: float) -> tuple[float, float]:
    """A range of distances without those below ``clearance``, where bodies would overlap."""
    low, high = value
    if high < clearance:
        raise ValueError(f"{name}={value} ends where bodies overlap: let it end beyond {clearance:.2f}")
    return max(low, clearance), high


def mocap_positions(model: mujoco.MjModel) -> Tensor:
    """Where a model has its mocap bodies, ``(M, 3)``."""
    return torch.from_numpy(model.body_pos[model.body_mocapid >= 0])


def horizontal_extent(model: mujoco.MjModel, num_bodies: int, low: float, high: float) -> float:
    """How far a character's rest pose extends horizontally from its root.

    Args:
        model: The scene, whose first bodies are the character's.
        num_bodies: Number of the character's bodies.
        low: The lowest height that counts, in metres.
        high: The highest.

    Returns:
        Radius in metres, of the boxes around its shapes.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    half_sizes = np.einsum("gij,gj->gi", np.abs(data.geom_xmat.reshape(-1, 3, 3)), model.geom_aabb[:, 3:])
    centres = data.geom_xpos - data.xpos[1] * [1, 1, 0]
    own = (model.geom_bodyid > 0) & (model.geom_bodyid <= num_bodies) & (model.geom_conaffinity > 0)
    own &= (centres[:, 2] - half_sizes[:, 2] < high) & (centres[:, 2] + half_sizes[:, 2] > low)
    corners = (np.abs(centres) + half_sizes)[own, :2]
    return float(np.hypot(*corners.T).max(initial=0.0))


def pointer(tail: Tensor, tip: Tensor) -> Arrow:
    """A horizontal arrow above ``tail``, towards ``tip`` and at most 1 m long."""
    way = (tip - tail) * torch.tensor([1.0, 1.0, 0.0])
    start = tail + torch.tensor([0.0, 0.0, 0.8])
    return start.numpy(), (start + way / way.norm().clamp_min(1.0)).numpy()
