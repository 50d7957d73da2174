"""Returns of players without a body: of one that stands still, and of one that does what a task asks for."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_mcp.adapters.contract import Reach

CLOSE = 0.01
"""Metres between a player and the object that it moves: at 0, the direction to the object is undefined."""


def transport_reach(
    reward: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor],
    com: Tensor,
    position: Tensor,
    target: Tensor,
    *,
    speed: float,
    timestep: float,
    num_steps: int,
    success_distance: float = 0.0,
    success_reach: float = math.inf,
) -> Reach:
    """Returns of a player that goes straight to an object, takes it straight to its target, and then waits.

    Args:
        reward: Function of the centre of mass, its velocity, the object's position, its velocity, and the target, each
            ``(N, 2)``.
        com: Initial position of the player, ``(N, 2)``, in metres.
        position: Initial position of the object, ``(N, 2)``, in metres.
        target: Position of the target, ``(N, 2)``, in metres.
        speed: Speed of player and object, in m/s.
        timestep: Duration of a step in seconds.
        num_steps: Steps of the episode.
        success_distance: Metres between object and target below which the reward is 1; 0 for none.
        success_reach: Metres between player and object below which a success counts; infinity for no limit.
    """

    def reward_of(*state: Tensor) -> Tensor:
        com, _, position, _, target = state
        left = torch.linalg.vector_norm(position - target, dim=-1)
        away = torch.linalg.vector_norm(position - com, dim=-1)
        return reward(*state).masked_fill((left < success_distance) & (away < success_reach), 1.0)

    still = torch.zeros_like(com)
    stride = speed * timestep
    standing = num_steps * reward_of(com, still, position, still, target)
    ideal = torch.zeros_like(standing)
    for _ in range(num_steps):
        at_hand = torch.linalg.vector_norm(position - com, dim=-1, keepdim=True) < CLOSE + 1e-6
        moved = torch.where(at_hand, _towards(position, target, stride), position)
        walked = _towards(com, moved, stride, stop=CLOSE)
        ideal += reward_of(walked, (walked - com) / timestep, moved, (moved - position) / timestep, target)
        com = walked
        position = moved
    return Reach(standing, ideal)


def _towards(start: Tensor, end: Tensor, stride: float, stop: float = 0.0) -> Tensor:
    """A step from ``start`` towards ``end``, at most ``stride`` long, ending at least ``stop`` away, ``(N, 2)``."""
    way = end - start
    distance = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
    length = (distance - stop).clamp(0.0, stride)
    return start + torch.nn.functional.normalize(way, dim=-1) * length
