"""Interactive control of a playing policy: its goal, the gates of its primitives, and pushes."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading
from torchrl_mcp.viewer.player import Player

TURN = math.radians(15)
"""Angle by which a key turns the target direction, in radians."""


class Steering:
    """A user's control of a playing policy, which viewers call on input from keys, sliders and the mouse.

    Settings persist over episodes, until :meth:`let_go`. A goal or a push takes effect in the next step.

    Args:
        player: The player to steer.

    Attributes:
        direction: The user's target direction of heading, in radians from the world's x axis, or None for the task's.
        place: The user's target position of an object, x and y in metres, or None for the task's.
    """

    def __init__(self, player: Player) -> None:
        self.player = player
        self.direction: float | None = None
        self.place: tuple[float, float] | None = None
        self._max_turn = player.env.max_turn if isinstance(player.env, Heading) else 0.0

    @property
    def has_direction(self) -> bool:
        """Whether the task has a direction to turn."""
        return isinstance(self.player.env, Heading)

    @property
    def has_place(self) -> bool:
        """Whether the task has a target to place."""
        return isinstance(self.player.env, Carry | Dribble)

    @property
    def target_direction(self) -> float:
        """Current target direction of heading, the user's or the task's, in radians from -pi to pi."""
        return _wrapped(float(self.player.env.episode["direction"][0]) if self.direction is None else self.direction)

    def aim(self, direction: float) -> None:
        """Set the target direction of heading, in radians from the world's x axis; it no longer wanders."""
        if isinstance(self.player.env, Heading):
            self.direction, self.player.env.max_turn = _wrapped(direction), 0.0

    def turn(self, angle: float) -> None:
        """Turn the target direction of heading, to the left by a positive angle in radians."""
        if self.has_direction:
            self.aim(self.target_direction + angle)

    def put(self, place: Sequence[float] | np.ndarray) -> None:
        """Place the target of the ball or the box on the ground, x and y in metres."""
        if self.has_place:
            self.place = float(place[0]), float(place[1])

    def pin(self, primitive: int, weight: float) -> None:
        """Hold the gate of a primitive, counted from 0, at a weight."""
        self.player.pinned = self.player.pinned | {primitive: min(max(weight, 0.0), 1.0)}

    def release(self, primitive: int) -> None:
        """Return control of a primitive's weight to the gate."""
        self.player.pinned = {other: weight for other, weight in self.player.pinned.items() if other != primitive}

    def play_alone(self, primitive: int) -> None:
        """Pin the gates so that one primitive acts alone: its weight is 1, the others are 0."""
        if (weights := self.player.weights) is not None and self.player.has_gates:
            self.player.pinned = {other: float(other == primitive) for other in range(len(weights.values))}

    def play_next_alone(self, step: int) -> None:
        """Let the next primitive act alone, or the previous one if ``step`` is -1; after the last, release the gate."""
        if (weights := self.player.weights) is None:
            return
        alone = [number for number, weight in self.player.pinned.items() if weight == 1.0]
        place = ((alone[0] if alone else len(weights.values)) + step) % (len(weights.values) + 1)
        self.player.pinned = {}
        if place < len(weights.values):
            self.play_alone(place)

    def push(self, forces: np.ndarray) -> None:
        """Push bodies with constant forces, until the next call.

        Args:
            forces: Forces and torques on each body in N and N m, MuJoCo's ``xfrc_applied``, shape ``(nbody, 6)``.
        """
        self.player.env.simulation.state["xfrc_applied"][0] = torch.from_numpy(forces)

    def reset(self) -> None:
        """Begin a new episode."""
        self.player.reset()

    def let_go(self) -> None:
        """Return control of goal and gates to task and policy."""
        self.direction = self.place = None
        self.player.pinned = {}
        if isinstance(self.player.env, Heading):
            self.player.env.max_turn = self._max_turn

    def step(self) -> None:
        """Let the policy act once, with the user's goal and gates."""
        env = self.player.env
        if self.direction is not None:
            env.episode["direction"][0] = self.direction
        if self.place is not None:
            env.simulation.state["mocap_pos"][0, 0, :2] = torch.tensor(self.place)
        self.player.step()


def _wrapped(angle: float) -> float:
    """Return an angle between -pi and pi."""
    return math.remainder(angle, 2 * math.pi)
