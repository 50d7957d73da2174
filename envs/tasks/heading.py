"""The heading task: walk in a direction that keeps changing, and optionally at changing speeds."""

from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchrl_mcp.adapters.contract import Reach
from torchrl_mcp.envs.characters.contract import CONTROL_TIMESTEP
from torchrl_mcp.envs.characters.mirror import VECTOR_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.observations import UNITS
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.rotations import unit_vector
from torchrl_mcp.envs.steering import Steerable, UserGoal
from torchrl_mcp.envs.tasks.places import LOGARITHMIC
from torchrl_mcp.envs.tasks.ranges import Ranges
from torchrl_mcp.envs.tasks.rewards import heading_reward, velocity_reward
from torchrl_mcp.envs.tasks.waypoints import place_ahead, place_seen
from torchrl_mcp.values import Count, NotNegative, PositiveOrInfinite, Range, Speed, checked


class Heading(PDCharacterEnv):
    r"""A character walks at a given speed in a direction that wanders.

    .. math:: \hat{\theta}_t = \hat{\theta}_{t-1} + \mathrm{Uniform}(-\delta, \delta)

    ``goal`` (2) is the unit vector of the target direction in the character's heading frame. The reward of a step uses
    the direction that the policy saw when it acted.

    With a range of speeds, the task draws a new speed from time to time, and ``goal`` (3) ends with the speed in m/s.
    The reward then also depends on the velocity across the direction, see
    :func:`~torchrl_mcp.envs.tasks.rewards.velocity_reward`.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        max_turn: Largest change :math:`\delta` of the direction per step, in radians. Paper: 0.15.
        speed: Target speed :math:`\hat{v}`, in m/s, or a range (lo, hi), which may begin at 0. Paper: 1.
        speed_interval: Mean time between changes of the speed in a range, in seconds; infinite for no changes.
        waypoint: Whether the goal ends with a place in the target direction, see
            :func:`~torchrl_mcp.envs.tasks.waypoints.place_ahead`, as :func:`.place_seen` shows it. ``goal_layout`` has
            the names of the entries.
        initial_directions: Range (lo, hi) of the first direction, in radians from the direction that the character
            faces. The paper does not specify it. Its returns of 0.97 leave no time to turn round, hence the default.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``; 600 are 20 s.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> from torchrl_mcp.envs import Heading
        >>> env = Heading("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 105])
    """

    units = MappingProxyType({**UNITS, "direction": "unit vector", "speed": "m/s", "waypoint": LOGARITHMIC})

    @checked
    def __init__(
        self,
        character: str,
        num_envs: Count,
        *,
        max_turn: NotNegative = 0.15,
        speed: Speed = 1.0,
        speed_interval: PositiveOrInfinite = 3.0,
        waypoint: bool = False,
        initial_directions: Range = (0.0, 0.0),
        max_episode_steps: Count = 600,
        **kwargs: Any,
    ) -> None:
        self.max_turn = max_turn
        self.speeds = (speed, speed) if isinstance(speed, int | float) else (float(speed[0]), float(speed[1]))
        self.waypoint = waypoint
        shown = 3 if self.changes_speed else 2
        self.goal_layout = {"direction": slice(0, 2)}
        if self.changes_speed:
            self.goal_layout["speed"] = slice(2, 3)
        if waypoint:
            self.goal_layout["waypoint"] = slice(shown, shown + 2)
        self.change_probability = CONTROL_TIMESTEP / speed_interval
        zero = torch.zeros((), dtype=torch.float64)
        super().__init__(
            character,
            num_envs,
            max_episode_steps=max_episode_steps,
            episode={"direction": zero, "speed": zero + self.speeds[1]},
            **kwargs,
        )
        self.ranges = Ranges({"initial_directions": initial_directions}, self.curriculum.mixture).to(self.device)
        self._steered = False
        self.make_specs()

    @property
    def changes_speed(self) -> bool:
        """Whether the speed has a range, and changes."""
        return self.speeds[0] < self.speeds[1]

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The character, a direction, and in a range of speeds one of them."""
        direction = self.ranges.draw(num, self.generator)["initial_directions"]
        start = {**super().initial_state(num), "direction": direction}
        return {**start, "speed": self._uniform(num, *self.speeds)} if self.changes_speed else start

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, the target direction as it sees it, and the speed if it changes."""
        goal = unit_vector(self.episode["direction"][ids] - self.heading(ids))
        if self.changes_speed:
            goal = torch.cat([goal, self.episode["speed"][ids].unsqueeze(-1)], -1)
        if self.waypoint:
            place = place_ahead(self.com[:, :2], self._target_velocity())
            goal = torch.cat([goal, place_seen(self, place, ids)], -1)
        return {"observation": self.see(ids)[0], "goal": goal}

    def reward(self) -> Tensor:
        """Reward of appendix D; with a range of speeds, its form for a velocity."""
        return self._reward_of(self.velocity("com")[:, :2])

    def update_goal(self) -> None:
        """Let the direction wander, and change some of the speeds."""
        turns = self._uniform(self.num_envs, -self.max_turn, self.max_turn)
        if self._steered:
            turns[0] = 0.0
        self.episode["direction"] += turns
        if self.changes_speed:
            speed = self.episode["speed"]
            another = self._uniform(self.num_envs, *self.speeds)
            changes = self._uniform(self.num_envs, 0.0, 1.0) < self.change_probability
            if self._steered:
                changes[0] = False
            speed.copy_(torch.where(changes, another, speed))

    @property
    def steerable(self) -> Steerable:
        """See :attr:`.CharacterEnv.steerable`: the direction, and the speed if it has a range."""
        return Steerable(
            direction=float(self.episode["direction"][0]),
            speed=float(self.episode["speed"][0]),
            speeds=self.speeds if self.changes_speed else None,
        )

    def steer(self, goal: UserGoal) -> None:
        """See :meth:`.CharacterEnv.steer`: while the user sets the direction or the speed, the task changes neither."""
        self._steered = goal.direction is not None or goal.speed is not None
        if goal.direction is not None:
            self.episode["direction"][0] = goal.direction
        if goal.speed is not None:
            self.episode["speed"][0] = goal.speed

    def reach(self) -> Reach | None:
        """See :meth:`CharacterEnv.reach`; None with a range of speeds, which are drawn as the episode goes on.

        The ideal player walks at the target speed from the first step on.
        """
        if self.changes_speed:
            return None
        standing = self._reward_of(torch.zeros(self.num_envs, 2, dtype=torch.float64, device=self.device))
        return Reach(self.max_episode_steps * standing, torch.full_like(standing, self.max_episode_steps))

    def goal_mirror(self) -> Mirror:
        """See :meth:`PDCharacterEnv.goal_mirror`."""
        speed = [1] * self.changes_speed
        place = VECTOR_SIGNS * self.waypoint
        return mirror_signs([*VECTOR_SIGNS, *speed, *place])

    def arrows(self, index: int) -> list[Arrow]:
        """See :meth:`CharacterEnv.arrows`: an arrow in the target direction, of the speed's length in a second."""
        tail = self.com[index].cpu() + torch.tensor([0.0, 0.0, 0.9]) * self._rest[2].cpu()  # above the head
        way = unit_vector(self.episode["direction"][index].cpu()) * self.episode["speed"][index].cpu()
        return [(tail.double().numpy(), (tail + torch.nn.functional.pad(way, (0, 1))).numpy())]

    def _uniform(self, num: int, low: float, high: float) -> Tensor:
        """Draw numbers between two bounds, ``(num,)``, float64."""
        numbers = torch.empty(num, dtype=torch.float64, device=self.device)
        return numbers.uniform_(low, high, generator=self.generator)

    def _reward_of(self, velocity: Tensor) -> Tensor:
        """Reward of a velocity of the centre of mass ``(N, 2)`` with the current goals, ``(N,)``."""
        if self.changes_speed:
            return velocity_reward(velocity, self._target_velocity())
        return heading_reward(velocity, unit_vector(self.episode["direction"]), self.speeds[0])

    def _target_velocity(self) -> Tensor:
        """The target direction times the target speed, ``(N, 2)``, in m/s."""
        return unit_vector(self.episode["direction"]) * self.episode["speed"].unsqueeze(-1)
