"""Lets a user control a playing policy: its goal, the gates of its primitives, and pushes."""

import math
import sys
from collections.abc import Sequence

import numpy as np
import torch

from torchrl_mcp.envs.steering import UserGoal
from torchrl_mcp.viewer.player import Player

TURN = math.radians(15)
"""Angle by which a key turns the target direction, in radians."""

SLOWEST = 0.05
"""Lowest speed of a viewer, as a share of real time. A viewer reacts to input only once per control step."""

SPEED_STEP = 0.25
"""Amount by which a key changes the target speed, in m/s."""


class Steering:
    """A user's control of a playing policy, which viewers call on input from keys, sliders and the mouse.

    The user's settings persist over episodes until :meth:`release_all`. While the user sets the goal, episodes have no
    time limit. Once the user sets the direction or the speed of the task heading, the task changes neither at random.
    In the task location, the target then moves ahead of the character; at a speed of 0 it stays where it is. A goal or
    a push takes effect in the next step.

    Args:
        player: The player to steer.

    Attributes:
        direction: The user's target direction, in radians from the world's x axis, or None for the task's direction.
        speed: The user's target speed, in m/s, or None for the task's speed.
        place: The user's target position of the character or of an object, x and y in metres, or None for the task's
            position.
    """

    def __init__(self, player: Player) -> None:
        self.player = player
        self.direction: float | None = None
        self.speed: float | None = None
        self.place: tuple[float, float] | None = None
        self._time_limit = player.env.max_episode_steps

    @property
    def has_direction(self) -> bool:
        """Whether the task has a target direction."""
        return self.player.env.steerable.direction is not None

    @property
    def has_speed(self) -> bool:
        """Whether the task has a target speed."""
        return self.player.env.steerable.speeds is not None

    @property
    def has_place(self) -> bool:
        """Whether the task has a target position."""
        return self.player.env.steerable.place

    @property
    def target_direction(self) -> float:
        """Current target direction, the user's or the task's, in radians from -pi to pi."""
        if self.direction is None:
            return _wrapped(self.player.env.steerable.direction or 0.0)
        return self.direction

    @property
    def target_speed(self) -> float:
        """Current target speed, the user's or the task's, in m/s."""
        return self.player.env.steerable.speed if self.speed is None else self.speed

    def aim(self, direction: float) -> None:
        """Set the target direction, in radians from the world's x axis."""
        if self.has_direction:
            self._lead(direction, self.target_speed)

    def turn(self, angle: float) -> None:
        """Turn the target direction by an angle in radians; positive angles turn left."""
        if self.has_direction:
            self.aim(self.target_direction + angle)

    def walk(self, speed: float) -> None:
        """Set the target speed in m/s, clipped to the task's range."""
        if self.has_speed:
            self._lead(self.target_direction, speed)

    def accelerate(self, change: float) -> None:
        """Change the target speed by an amount in m/s."""
        if self.has_speed:
            self.walk(self.target_speed + change)

    def up(self, sign: int = 1) -> None:
        """Walk faster, or slower if ``sign`` is -1; in tasks without a speed, let another primitive act alone."""
        if self.has_speed:
            self.accelerate(sign * SPEED_STEP)
        else:
            self.play_next_alone(-sign)

    @property
    def can_stop(self) -> bool:
        """Whether :meth:`stop` has an effect."""
        return self.has_speed

    def stop(self) -> None:
        """Stop the character, or set the lowest of the task's speeds."""
        self.walk(0.0)

    def _lead(self, direction: float, speed: float) -> None:
        """Set direction and speed, which the task no longer changes at random."""
        speeds = self.player.env.steerable.speeds
        self.direction = _wrapped(direction)
        self.speed = min(max(speed, speeds[0]), speeds[1]) if speeds else None
        if self.has_place:
            x, y = self.player.env.com[0, :2].tolist()
            self.place = x, y  # at a speed of 0, the character stands where it is

    def put(self, place: Sequence[float] | np.ndarray) -> None:
        """Place the target of the character, the ball or the box on the ground, x and y in metres.

        If the character has already put the box down, it fetches the box again.
        """
        if self.has_place:
            self.place = float(place[0]), float(place[1])
            self.direction = None
            self.speed = None

    def pin(self, primitive: int, weight: float) -> None:
        """Fix the gate of a primitive, counted from 0, at a weight, which is clipped to the range from 0 to 1."""
        self.player.pinned = self.player.pinned | {primitive: min(max(weight, 0.0), 1.0)}

    def release(self, primitive: int) -> None:
        """Return control of a primitive's weight to the gate."""
        self.player.pinned = {number: weight for number, weight in self.player.pinned.items() if number != primitive}

    def play_alone(self, primitive: int) -> None:
        """Pin the gates so that one primitive acts alone, with weight 1, and all other weights are 0."""
        if (weights := self.player.weights) is not None and self.player.has_gates:
            self.player.pinned = {number: float(number == primitive) for number in range(len(weights.values))}

    def play_next_alone(self, step: int) -> None:
        """Let the next primitive act alone, or the previous one if ``step`` is -1.

        After the last primitive, and before the first, all gates are released.
        """
        if (weights := self.player.weights) is None:
            return
        alone = [number for number, weight in self.player.pinned.items() if weight == 1.0]
        place = ((alone[0] if alone else len(weights.values)) + step) % (len(weights.values) + 1)
        self.player.pinned = {}
        if place < len(weights.values):
            self.play_alone(place)

    def push(self, forces: np.ndarray) -> None:
        """Push bodies with constant forces until the next call.

        Args:
            forces: Force in N and torque in N m on each body, ``(nbody, 6)``, as MuJoCo's ``xfrc_applied``.
        """
        self.player.env.simulation.state["xfrc_applied"][0] = torch.from_numpy(forces)

    def reset(self) -> None:
        """Begin a new episode."""
        self.player.reset()

    def release_all(self) -> None:
        """Return control of the goal to the task, and control of the gates to the policy."""
        self.direction = None
        self.speed = None
        self.place = None
        self.player.pinned = {}
        env = self.player.env
        if env.max_episode_steps != self._time_limit:  # restore the time limit, counted from now
            env.max_episode_steps = self._time_limit
            env.episode["elapsed_steps"][0] = 0

    def step(self) -> None:
        """Let the policy act once, with the user's goal and gates."""
        env = self.player.env
        goal = UserGoal(self.direction, self.speed, self.place)
        env.steer(goal)
        if goal != UserGoal():
            env.max_episode_steps = sys.maxsize
        self.player.step()


def _wrapped(angle: float) -> float:
    """Return an angle between -pi and pi."""
    return math.remainder(angle, 2 * math.pi)
