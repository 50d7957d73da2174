"""The location task: go to a place and stand there, until another place is named."""

import math
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchrl_mcp.adapters.contract import Reach
from torchrl_mcp.envs.characters.mirror import VECTOR_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.observations import UNITS
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.physics.simulation import LARGEST
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.rotations import unit_vector
from torchrl_mcp.envs.steering import Steerable, UserGoal
from torchrl_mcp.envs.tasks.places import ANY_DIRECTION, LOGARITHMIC, logarithmic, near, steps
from torchrl_mcp.envs.tasks.ranges import Ranges
from torchrl_mcp.envs.tasks.rewards import ARRIVAL_DISTANCE, location_reward, location_velocity
from torchrl_mcp.envs.tasks.waypoints import place_ahead, walkable, way
from torchrl_mcp.values import Count, NotNegative, Positive, Range, checked, require

STANDING_SPEED = 0.1
"""Speed of the centre of mass in m/s below which a character stands."""

FACING = math.cos(math.radians(30))
"""Cosine of the largest angle between the heading and the direction to face for success."""


class Location(PDCharacterEnv):
    """A character goes to a place and stands there. From time to time, it is sent to another place.

    **Goal.** ``goal`` (2) is the place relative to the centre of mass in the character's heading frame, with a
    logarithmic distance, see :func:`~torchrl_mcp.envs.tasks.places.logarithmic`. A place at the character's side is
    shown as a place to which the character can walk, see :func:`~torchrl_mcp.envs.tasks.waypoints.walkable`. With
    ``final_directions``, ``goal`` (4) ends with the unit vector of the direction to face at the place.

    **Reward.** The reward is :func:`~torchrl_mcp.envs.tasks.rewards.location_reward`, for the place that the policy saw
    when it acted.

    **Metrics.** A character has arrived if it is within 0.3 m of the place.

    - ``success`` (1, bool) says whether the character has arrived and stands, that is, its centre of mass is slower
      than 0.1 m/s, and, with ``final_directions``, whether it faces the direction within 30 degrees.
    - ``at_place`` (1) is 1 if the character has arrived and 0 otherwise, so that its mean is a share of time.
    - ``seconds_to_success`` (1) is the duration of the episode until the first success at a place, and 0 afterwards.
      In an episode with one place that lasts until its time limit, the mean is the time to success, or the whole
      duration without success. A fall after the success shortens the episode, so that the mean is larger.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        target_distances: Range (lo, hi) of the distance of a new place from the character, in metres.
        target_directions: Range (lo, hi) of the direction of a new place, in radians from the character's heading.
        target_intervals: Range (lo, hi) of the time until the task draws another place, in seconds. The time passes
            while the character walks and while it stands.
        final_directions: Range (lo, hi) of the direction to face at the place, in radians from the heading at the time
            of the draw; None if the character may face any direction.
        speed: Target speed far from the place, in m/s.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``; 600 are 20 s.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.

    Reference:
        The task is not in the paper. Peng et al., AMP: Adversarial Motion Priors for Stylized Physics-Based Character
        Control, 2021, https://arxiv.org/abs/2104.02180, has a similar one.

    Example:
        >>> from torchrl_mcp.envs import Location
        >>> env = Location("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "goal"].shape
        torch.Size([2, 3, 2])
    """

    units = MappingProxyType({**UNITS, "place": LOGARITHMIC, "final_direction": "unit vector"})

    @checked
    def __init__(
        self,
        character: str,
        num_envs: Count,
        *,
        target_distances: Range = (0.0, 10.0),
        target_directions: Range = ANY_DIRECTION,
        target_intervals: Range = (3.0, 8.0),
        final_directions: Range | None = None,
        speed: Positive = 1.0,
        max_episode_steps: Count = 600,
        **kwargs: Any,
    ) -> None:
        self.speed = speed
        self.faces = final_directions is not None
        self.goal_layout = {"place": slice(0, 2)}
        if self.faces:
            self.goal_layout["final_direction"] = slice(2, 4)
        number = torch.zeros((), dtype=torch.float64)
        no = torch.zeros((), dtype=torch.bool)
        episode = {"target": number.repeat(2), "final_direction": number, "seconds_left": number}
        super().__init__(
            character,
            num_envs,
            max_episode_steps=max_episode_steps,
            episode={**episode, "arrived": no, "success": no, "reached": no},
            **kwargs,
        )
        ranges = {"target_distances": target_distances, "target_directions": target_directions}
        ranges |= {"target_intervals": target_intervals, "final_directions": final_directions or (0.0, 0.0)}
        self.ranges = Ranges(ranges, self.curriculum.mixture).to(self.device)
        self.ranges.require_distances("target_distances")
        shortest = self.ranges.lowest("target_intervals")
        require("target_intervals", shortest, NotNegative)
        self.one_place = shortest >= max_episode_steps * self.control_timestep
        self._steered = False
        self.make_specs()

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The character, and a place."""
        start = super().initial_state(num)
        return {**start, **self._place(start["qpos"][:, :2], torch.zeros(num, device=self.device))}

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, the place as it sees it, and metrics."""
        seen = [logarithmic(walkable(way(self, self.episode["target"], ids)))]
        if self.faces:
            angle = self.episode["final_direction"][ids] - self.heading(ids)
            seen.append(steps(torch.ones_like(angle), angle))
        duration = self.max_episode_steps * self.control_timestep
        return {
            "observation": self.see(ids)[0],
            "goal": torch.cat(seen, -1),
            "success": self.episode["success"][ids].unsqueeze(-1),
            "at_place": self.episode["arrived"][ids].double().unsqueeze(-1),
            "seconds_to_success": duration * (~self.episode["reached"][ids]).double().unsqueeze(-1),
        }

    def after_step(self, diverged: Tensor) -> None:
        """Measure whether the character has arrived, and stands."""
        episode = self.episode
        episode["arrived"].copy_(near(self.com, torch.nn.functional.pad(episode["target"], (0, 1)), ARRIVAL_DISTANCE))
        stands = torch.linalg.vector_norm(self.velocity("com")[:, :2], dim=-1) < STANDING_SPEED
        episode["success"].copy_(episode["arrived"] & stands & (self._alignment() > FACING) & ~self.fallen())
        episode["success"][diverged] = False  # who could not move does not stand
        episode["reached"] |= episode["success"]

    def reward(self) -> Tensor:
        """See :func:`~torchrl_mcp.envs.tasks.rewards.location_reward`."""
        return location_reward(self.velocity("com")[:, :2], self._offset(), self.speed, self._alignment())

    def update_goal(self) -> None:
        """Draw another place where the time for the last one is over."""
        self.episode["seconds_left"] -= self.control_timestep
        over = self.episode["seconds_left"] < self.control_timestep / 2
        over &= self.episode["elapsed_steps"].squeeze(-1) < self.max_episode_steps  # what the last step measures stays
        another = self._place(self.com[:, :2], self.heading())
        for name, value in {**another, "reached": torch.zeros_like(over)}.items():
            old = self.episode[name]
            old.copy_(torch.where(over.view(-1, *[1] * (old.ndim - 1)), value, old))

    @property
    def steerable(self) -> Steerable:
        """See :attr:`.CharacterEnv.steerable`: the place; a direction and a speed put it ahead of the character."""
        heading = float(self.heading(slice(1))[0])
        return Steerable(direction=heading, speed=self.speed, speeds=(0.0, self.speed), place=True)

    def steer(self, goal: UserGoal) -> None:
        """See :meth:`.CharacterEnv.steer`: a place that the user sets stays.

        When the user releases the place, the task draws another.
        """
        target = None if goal.place is None else self.com.new_tensor(goal.place)
        if goal.direction is not None and goal.speed:
            velocity = goal.speed * unit_vector(self.com.new_tensor(goal.direction))
            target = place_ahead(self.com[0, :2], velocity)
        if target is not None:
            self.episode["target"][0] = target
            self.episode["seconds_left"][0] = LARGEST / 2  # finite, so that a snapshot can be restored
        elif self._steered:
            self.episode["seconds_left"][0] = 0.0
        self._steered = target is not None

    def reach(self) -> Reach | None:
        """See :meth:`CharacterEnv.reach`; None if an episode has several places, which are drawn as it goes on.

        The ideal player goes straight to the place at the target speed, and earns the most for velocity and direction.
        """
        if not self.one_place:
            return None
        still = torch.zeros_like(self._offset())
        offset = self._offset()
        standing = self.max_episode_steps * location_reward(still, offset, self.speed, self._alignment())
        times = torch.arange(1, self.max_episode_steps + 1, device=self.device) * self.control_timestep
        distance = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
        left = (1 - self.speed * times / distance).clamp(min=0.0).unsqueeze(-1) * offset.unsqueeze(1)
        return Reach(standing, location_reward(location_velocity(left, self.speed), left, self.speed).sum(-1))

    def goal_mirror(self) -> Mirror:
        """See :meth:`PDCharacterEnv.goal_mirror`."""
        return mirror_signs(VECTOR_SIGNS * (2 if self.faces else 1))

    def arrows(self, index: int) -> list[Arrow]:
        """See :meth:`CharacterEnv.arrows`: an arrow down to the place, and one in the direction to face there."""
        place = torch.nn.functional.pad(self.episode["target"][index].cpu(), (0, 1))
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        angle = self.episode["final_direction"][index].cpu()
        ahead = torch.nn.functional.pad(steps(torch.ones_like(angle), angle), (0, 1))
        ends = [(place + up, place), (place + 0.1 * up, place + 0.1 * up + 0.6 * ahead)]
        return [(tail.numpy(), tip.numpy()) for tail, tip in ends[: 2 if self.faces else 1]]

    def _place(self, origin: Tensor, heading: Tensor) -> dict[str, Tensor]:
        """Draw a place for each of n characters, from where they are ``(n, 2)`` and where they face ``(n,)``."""
        drawn = self.ranges.draw(len(origin), self.generator)
        return {
            "target": origin + steps(drawn["target_distances"], heading + drawn["target_directions"]),
            "final_direction": heading + drawn["final_directions"],
            "seconds_left": drawn["target_intervals"],
        }

    def _offset(self) -> Tensor:
        """The place relative to the centre of mass, ``(N, 2)``, in metres."""
        return self.episode["target"] - self.com[:, :2]

    def _alignment(self) -> Tensor:
        """Cosine of the angle between heading and direction to face, 1 if any will do, ``(N,)``."""
        heading = self.heading()
        return (self.episode["final_direction"] - heading).cos() if self.faces else torch.ones_like(heading)
