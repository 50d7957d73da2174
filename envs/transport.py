"""The base class of carrying and dribbling: moving an object to a target."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.arguments import positive
from torchrl_mcp.envs.goals import POSITIONS, goal_layout, logarithmic
from torchrl_mcp.envs.ideal import Reach, transport_reach
from torchrl_mcp.envs.mirror import BODY_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.motions.kinematics import BodyStates
from torchrl_mcp.envs.observations import bodies_in_heading_frame
from torchrl_mcp.envs.rendering import Arrow
from torchrl_mcp.envs.rewards import idle_reward
from torchrl_mcp.envs.transfer import TransferTask

SUCCESS_DISTANCE = 0.5
"""Distance in metres between object and target for success, as in the same authors' public code."""

ANY_DIRECTION = (-math.pi, math.pi)
"""All directions, in radians."""


class Transport(TransferTask):
    """A character moves an object to a target; distances and directions are drawn uniformly for each episode.

    ``goal`` describes the scene's other bodies in the character's heading frame, with positions relative to the root;
    ``goal_layout`` has the names of its entries. ``success`` (1, bool) is whether the object is at the target, that is,
    horizontally within 0.5 m.

    The reward is by default as printed in the paper. Two variants of the same authors' public code are options: the
    distance to the target instead of its square, which still has a gradient at 10 m, and reward 1 while successful. An
    object at rest at the target has a printed reward of at most 0.73; with the second variant it is 1.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        things: Bodies that ``furnish`` adds, in this order, the target first and the object last, each with how many
            numbers the goal has of position (3), orientation (4), linear (3) and angular velocity (3).
        furnish: Function that adds these bodies to the scene: the object with 7 coordinates and 6 velocities, the
            others as mocap bodies.
        reward: :func:`~torchrl_mcp.envs.rewards.transport_reward` with the task's constants.
        object_distances: Range (lo, hi) of the object's distance from the character, in metres; lo is raised until they
            do not overlap.
        object_directions: Range (lo, hi) of the direction of the object, in radians from the character's heading.
        target_distances: Range (lo, hi) of the target's distance from the object, in metres.
        target_directions: Range (lo, hi) of the direction from the object to the target, in radians from the direction
            of the object: 0 is straight beyond the object.
        speed: Target speed of character and object, in m/s. Paper: 1.
        target_distance_power: Power of the distance between object and target in the reward: 2 (paper) or 1.
        success_reward: Set the reward to 1 while successful.
        goal_positions: Form of the horizontal positions in ``goal``: ``"metres"``, or ``"logarithmic"``, see
            :func:`~torchrl_mcp.envs.goals.logarithmic`. A table is 0.3 m wide, and in standardised metres this is less
            than a tenth.
        emphasis: ``weights`` of the four terms and ``target_distance_power`` of the reward for training, in which speed
            terms are 0 while standing still; None for the task's own. With the printed reward, standing still earns a
            third of the best return, and policies learn to stand. A success ends the episode, with the discounted
            return of all terms being 1 for ever: otherwise a character that walks on knocks the box off the target,
            and a success is worth little.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``. The paper speaks of thousands of steps;
            3000 are 100 s, as in the same authors' public code for a ball.
        episode: Initial task state of one simulation, in addition to the object's position.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.transfer.TransferTask`: aids for training.

    Raises:
        ValueError: If an argument is out of range.
    """

    success_distance = SUCCESS_DISTANCE
    """Metres between object and target at which an ideal player has succeeded."""

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        things: Mapping[str, int],
        furnish: Callable[[mujoco.MjSpec], None],
        reward: Callable[..., Tensor],
        object_distances: Sequence[float] = (0.0, 10.0),
        object_directions: Sequence[float] = ANY_DIRECTION,
        target_distances: Sequence[float] = (0.0, 10.0),
        target_directions: Sequence[float] = ANY_DIRECTION,
        speed: float = 1.0,
        target_distance_power: float = 2,
        success_reward: bool = False,
        goal_positions: str = "metres",
        emphasis: Mapping[str, Any] | None = None,
        max_episode_steps: int = 3000,
        episode: Mapping[str, Tensor] | None = None,
        **kwargs: Any,
    ) -> None:
        positive(speed=speed)
        if target_distance_power not in (1, 2):
            raise ValueError(f"target_distance_power={target_distance_power} is out of range: pass 2 (paper) or 1")
        if goal_positions not in POSITIONS:
            raise ValueError(f"goal_positions={goal_positions!r} is unknown: pass {' or '.join(POSITIONS)}")
        self._logarithmic = goal_positions == "logarithmic"
        self.success_reward, self.speed = success_reward, speed
        self.goal_layout = goal_layout(things)
        """Slices of ``goal`` by name."""
        self._shown = dict(things)
        if emphasis is not None and kwargs.get("discount") == 1:
            raise ValueError(
                "emphasis with discount=1: a success is worth full reward for ever, pass a discount below 1"
            )
        self._reward = partial(reward, speed=speed, target_distance_power=target_distance_power)
        self._emphasised, self._idle, self._full = None, 0.0, 1.0
        if emphasis is not None:
            if set(emphasis) != {"weights", "target_distance_power"} or len(emphasis["weights"]) != 4:
                raise ValueError(f"emphasis={dict(emphasis)}: pass four weights and a target_distance_power")
            self._emphasised = partial(self._reward, **emphasis)
            self._idle, self._full = idle_reward(emphasis["weights"], speed), sum(emphasis["weights"])
        super().__init__(
            character,
            num_envs,
            practised=emphasis is not None,
            ranges={
                "object_distances": object_distances,
                "object_directions": object_directions,
                "target_distances": target_distances,
                "target_directions": target_directions,
            },
            max_episode_steps=max_episode_steps,
            episode={"object": torch.zeros(3, dtype=torch.float64), **(episode or {})},
            furnish=furnish,
            **kwargs,
        )
        self.ranges.require_distances("object_distances", "target_distances")
        # Live views, made once. The task's bodies follow the character's.
        rows, outputs = slice(1 + len(self._bodies), None), self.simulation.outputs
        angular, linear = outputs["cvel"][:, rows].split(3, -1)
        self._things = BodyStates(outputs["xpos"][:, rows], outputs["xquat"][:, rows], linear, angular)
        self._look_at(slice(1, None))  # together they take little longer than the character alone
        self._target, self._object = self._things.positions[:, 0], self._things.positions[:, -1]
        self._marks = mocap_positions(self.simulation.model).to(self.device)

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is the worst possible and 1 the best, :math:`\bar{R} = R / T`.

        :math:`R` is the undiscounted return and :math:`T` ``max_episode_steps``: a reward is at most 1. The paper's
        normalisation is not documented.
        """
        return episode_return / self.max_episode_steps

    def _goal_mirror(self) -> Mirror:
        return mirror_signs([sign for size in self._shown.values() for sign in BODY_SIGNS[:size]])

    def reach(self) -> Reach:
        """Returns of standing still, and of an ideal player that takes the object straight to its target."""

        def reward(*state: Tensor) -> Tensor:
            left = torch.linalg.vector_norm(state[2] - state[4], dim=-1)
            succeeded = (left < self.success_distance) & self.success_reward
            return self._reward(*state).masked_fill(succeeded, 1.0)

        return transport_reach(
            reward,
            *(part[:, :2].clone() for part in (self._com, self._object, self._target)),
            speed=self.speed,
            timestep=self.control_timestep,
            num_steps=self.max_episode_steps,
        )

    def success(self) -> Tensor:
        """Whether the object is at the target, shape ``(N,)``, bool."""
        return torch.linalg.vector_norm((self._object - self._target)[:, :2], dim=-1) < SUCCESS_DISTANCE

    def _extent(self, low: float, high: float) -> float:
        """Largest initial horizontal extent of the character from its root between two heights, all in metres."""
        return horizontal_extent(self.simulation.model, len(self._bodies), self.beginnings.poses(), low, high)

    def _sample(self, num: int) -> dict[str, Tensor]:
        start, drawn = super()._sample(num), self.ranges.draw(num, self.generator)
        marks = self._marks.repeat(num, 1, 1)
        directions = drawn["object_directions"], drawn["object_directions"] + drawn["target_directions"]
        place = start["qpos"][:, :2] + steps(drawn["object_distances"], directions[0])
        start["qpos"][:, -7:-5] = place
        marks[:, 0, :2] = place + steps(drawn["target_distances"], directions[1])
        return {**start, "mocap_pos": marks}

    def _begin(self, ids: Tensor) -> dict[str, Tensor]:
        return {**super()._begin(ids), "object": self._object[ids]}

    def _show(self, ids: Tensor | slice) -> dict[str, Tensor]:
        bodies = self._body_states(ids)
        root, angle = bodies.positions[:, 0], self.heading(ids).to(self._dtype)
        seen = bodies_in_heading_frame(angle, root, bodies).unflatten(-1, (-1, 13))
        own, things = seen.split([len(self._bodies), len(self._shown)], 1)
        if self._logarithmic:
            things[..., :2] = logarithmic(things[..., :2])
        shown = [things[:, index, :size] for index, size in enumerate(self._shown.values())]
        return {
            "observation": torch.cat([root[:, 2:], own.flatten(1)], -1),
            "goal": torch.cat(shown, -1),
            "success": self.success()[ids].unsqueeze(-1),
        }

    def _rewards(self) -> Tensor:
        object_velocity = (self._object - self.episode["object"]) / self.control_timestep
        self.episode["object"].copy_(self._object)
        state = (
            self._com[:, :2],
            self._com_velocity(),
            self._object[:, :2],
            object_velocity[:, :2],
            self._target[:, :2],
        )
        reward = self._reward(*state)
        if self.success_reward:
            reward = reward.masked_fill(self.success(), 1.0)
        if self._emphasised is None:
            return reward.unsqueeze(0)
        return torch.stack([reward, self._emphasised(*state) - self._idle])

    def _reward_and_termination(self, diverged: Tensor) -> tuple[Tensor, Tensor]:
        reward, terminated = super()._reward_and_termination(diverged)
        if self._emphasised is None:
            return reward, terminated
        succeeded = self.success() & ~terminated
        for_ever = (self._full - self._idle) / (1 - self.discount)
        return reward.masked_fill(succeeded, for_ever), terminated | succeeded

    def arrows(self, index: int) -> list[Arrow]:
        """Arrows from above the character to the object, and from above the object to the target."""
        return [
            pointer(self._com[index], self._object[index]),
            pointer(self._object[index], self._target[index]),
        ]


def steps(distances: Tensor, directions: Tensor) -> Tensor:
    """Displacements ``(*B, 2)`` from lengths in metres and directions in radians."""
    return torch.stack([directions.cos(), directions.sin()], -1) * distances.unsqueeze(-1)


def mocap_positions(model: mujoco.MjModel) -> Tensor:
    """Positions of a model's mocap bodies, ``(M, 3)``."""
    return torch.from_numpy(model.body_pos[model.body_mocapid >= 0])


def horizontal_extent(model: mujoco.MjModel, num_bodies: int, poses: Tensor, low: float, high: float) -> float:
    """Horizontal extent of a character from its root.

    Args:
        model: The scene, whose first bodies are the character's.
        num_bodies: Number of the character's bodies.
        poses: Coordinates of the character, ``(P, nq)``.
        low: Lowest height to include, in metres.
        high: Highest height to include, in metres.

    Returns:
        Largest radius in metres of the boxes around the character's shapes, over all poses.
    """
    data, radius = mujoco.MjData(model), 0.0
    own = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_bodyid <= num_bodies) & (model.geom_conaffinity > 0))
    for pose in poses.cpu().numpy():
        data.qpos[: len(pose)] = pose
        mujoco.mj_kinematics(model, data)
        half_sizes = np.einsum("gij,gj->gi", np.abs(data.geom_xmat[own].reshape(-1, 3, 3)), model.geom_aabb[own, 3:])
        centres = data.geom_xpos[own] - data.xpos[1] * [1, 1, 0]
        between = (centres[:, 2] - half_sizes[:, 2] < high) & (centres[:, 2] + half_sizes[:, 2] > low)
        corners = (np.abs(centres) + half_sizes)[between, :2]
        radius = max(radius, float(np.hypot(*corners.T).max(initial=0.0)))
    return radius


def pointer(tail: Tensor, tip: Tensor) -> Arrow:
    """A horizontal arrow above ``tail``, towards ``tip`` and at most 1 m long."""
    tail, tip = tail.double().cpu(), tip.double().cpu()
    way = (tip - tail) * torch.tensor([1.0, 1.0, 0.0])
    start = tail + torch.tensor([0.0, 0.0, 0.8])
    return start.numpy(), (start + way / way.norm().clamp_min(1.0)).numpy()
