"""What a return can reach: players without a body, who move as fast as a task asks for."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

CLOSE = 0.01
"""Metres between a player and the object that it moves: at none, the direction to the object is not defined."""


class Reach(NamedTuple):
    """Two returns between which those of a learner lie.

    Args:
        standing: Of a player who does nothing and does not fall, ``(N,)``.
        ideal: Of a player to whom the task's speed is the only limit, ``(N,)``.
    """

    standing: Tensor
    ideal: Tensor

    def place(self, returns: Tensor) -> Tensor:
        """Place of returns between the two, on average: 0 for standing still, 1 for the ideal, ``()``."""
        standing = self.standing.mean()
        return (returns.mean() - standing) / (self.ideal.mean() - standing)


def transport_reach(
    reward: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor],
    com: Tensor,
    position: Tensor,
    target: Tensor,
    *,
    speed: float,
    timestep: float,
    num_steps: int,
) -> Reach:
    """Returns of who brings an object to its target: straight to the object, with it to the target, and then waits.

    Args:
        reward: Of centre of mass, its velocity, the object's position, its velocity, and the target, each ``(N, 2)``.
        com: Where the player begins, ``(N, 2)``, in metres.
        position: Where the object begins.
        target: Where it is to go.
        speed: Of player and object, in m/s.
        timestep: Seconds of a step.
        num_steps: Of the episode.
    """
    still, stride = torch.zeros_like(com), speed * timestep
    standing = num_steps * reward(com, still, position, still, target)
    ideal = torch.zeros_like(standing)
    for _ in range(num_steps):
        at_hand = torch.linalg.vector_norm(position - com, dim=-1, keepdim=True) < CLOSE + 1e-6
        moved = torch.where(at_hand, _towards(position, target, stride), position)
        walked = _towards(com, moved, stride, stop=CLOSE)
        ideal += reward(walked, (walked - com) / timestep, moved, (moved - position) / timestep, target)
        com, position = walked, moved
    return Reach(standing, ideal)


def _towards(start: Tensor, end: Tensor, stride: float, stop: float = 0.0) -> Tensor:
    """A step from ``start``, at most as long as ``stride`` and no further than ``stop`` before ``end``, ``(N, 2)``."""
    way = end - start
    distance = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    length = (distance - stop).clamp(0.0, stride)
    return start + torch.nn.functional.normalize(way, dim=-1) * length
