"""Where a character should go next: places on the ground, and how it sees them."""

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_mcp.envs.base import ALL
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.tasks.places import logarithmic, near, steps
from torchrl_mcp.envs.tasks.rewards import ARRIVAL_DISTANCE, SUCCESS_DISTANCE, SUCCESS_REACH

STRIDE = 1.0
"""Largest distance in metres of the next place while carrying: the further the place, the faster the walk."""

WALK_AHEAD = 1.5
"""Seconds of walking at the target speed to a place ahead: at every step of speed it is beyond arrival."""

PUSH = 0.5
"""Distance in metres to walk behind a ball and to the side of it, and the largest beyond it."""

SHARE = 0.1
"""Distance to walk beyond a ball, as a share of the ball's distance from the target: the further, the faster."""

BEHIND = 0.7
"""Cosine of the angle between the ways to ball and target, above which a character is behind the ball."""

ASIDE = math.radians(45)
"""Largest angle in radians between a character's heading and the place to which it goes."""

STEP = 0.5
"""Distance in metres of a place that is shown at the angle :data:`ASIDE`."""


def place_ahead(com: Tensor, velocity: Tensor) -> Tensor:
    """The place where a character is after :data:`WALK_AHEAD` at a velocity; at rest, where it stands.

    Args:
        com: Centre of mass of the character, ``(*B, 2)``, in metres.
        velocity: Target velocity, ``(*B, 2)``, in m/s.

    Returns:
        Places, ``(*B, 2)``.
    """
    return com + WALK_AHEAD * velocity


def carry_waypoint(com: Tensor, box: Tensor, target: Tensor, taken: Tensor, held: Tensor) -> Tensor:
    """The box, then on the way on which the box in hand comes to the target, then where the character stands.

    The way ends :data:`ARRIVAL_DISTANCE` past the target, because a gate for
    :class:`.Location` stops that far before a place.

    Args:
        com: Centre of mass of the character, ``(N, 2)``, in metres.
        box: Position of the box, ``(N, 2)``.
        target: Position of the target, ``(N, 2)``.
        taken: Whether the box was taken, ``(N,)``, bool.
        held: Whether it is held, ``(N,)``, bool.

    Returns:
        Places, ``(N, 2)``.
    """
    way = target - box
    length = torch.linalg.vector_norm(way, dim=-1, keepdim=True) + ARRIVAL_DISTANCE
    bringing = com + normalize(way, dim=-1) * length.clamp(max=STRIDE)
    held, done = held.unsqueeze(-1), (taken & ~held).unsqueeze(-1)
    return torch.where(held, bringing, torch.where(done, com, box))


def dribble_waypoint(com: Tensor, ball: Tensor, rest: Tensor, target: Tensor) -> Tensor:
    """Around the ball until the character is behind it, then through it, then where the character stands.

    The ball is met halfway to where it comes to rest. The nearer this is to the target, the slower it is pushed. A ball
    that comes to rest at the target is left alone, and the character then stands within :data:`SUCCESS_REACH` of it.

    Args:
        com: Centre of mass of the character, ``(N, 2)``, in metres.
        ball: Position of the ball, ``(N, 2)``.
        rest: Where the ball comes to rest, ``(N, 2)``.
        target: Position of the target, ``(N, 2)``.

    Returns:
        Places, ``(N, 2)``.
    """
    now = ball
    ball = (ball + rest) / 2
    way = target - ball
    approach = normalize(ball - com, dim=-1)
    onward = normalize(way, dim=-1)
    left = torch.stack([-onward[:, 1], onward[:, 0]], -1)
    alignment = (approach * onward).sum(-1, keepdim=True)
    side = -(approach * left).sum(-1, keepdim=True).sign() * (alignment < 0)  # of the ball, if it is in the way
    beyond = (SHARE * torch.linalg.vector_norm(way, dim=-1, keepdim=True)).clamp(max=PUSH) * onward
    place = ball + torch.where(alignment > BEHIND, beyond, PUSH * (side * left - onward))
    standing = torch.where(near(com, now, SUCCESS_REACH).unsqueeze(-1), com, now)
    return torch.where(near(rest, target, SUCCESS_DISTANCE).unsqueeze(-1), standing, place)


def place_seen(env: PDCharacterEnv, place: Tensor, ids: Tensor | slice = ALL) -> Tensor:
    """A place as a gate for :class:`.Location` sees one ahead of it, in the environment of any task.

    Args:
        env: The environment.
        place: Places on the ground, ``(N, 2)``, in metres.
        ids: Simulations, ``(n,)``.

    Returns:
        Each place relative to the centre of mass in the character's heading frame, with a logarithmic distance,
        ``(n, 2)``.
    """
    return logarithmic(way(env, place, ids))


def way(env: PDCharacterEnv, place: Tensor, ids: Tensor | slice = ALL) -> Tensor:
    """Like :func:`place_seen`, in metres, ``(n, 2)``."""
    return _turned((place - env.com[:, :2])[ids], -env.heading(ids))


def walkable(offset: Tensor) -> Tensor:
    """Replace places more than :data:`ASIDE` aside, which a character could face only by turning on the spot.

    A place beyond :data:`STEP` is shown at this angle and at the distance :data:`STEP`, so that the character turns on
    an arc. A place within :data:`ARRIVAL_DISTANCE` is shown at the character, so that the character does not turn back
    to a place that it has overshot. Characters fall when they turn on the spot, the T-Rex most. The paper has no such
    task; angle and distances were chosen by falls of the built-in gates.

    Args:
        offset: Places relative to a character in its heading frame, ``(*B, 2)``, in metres.

    Returns:
        Places in the same frame, ``(*B, 2)``, in metres.
    """
    angle = torch.atan2(offset[..., 1], offset[..., 0])
    distance = torch.linalg.vector_norm(offset, dim=-1)
    on_arc = steps(torch.full_like(distance, STEP), ASIDE * angle.sign())
    aside = angle.abs() > ASIDE
    far = (aside & (distance > STEP)).unsqueeze(-1)
    reached = (aside & (distance < ARRIVAL_DISTANCE)).unsqueeze(-1)
    return torch.where(far, on_arc, torch.where(reached, 0.0, offset))


def _turned(vectors: Tensor, angle: Tensor) -> Tensor:
    """Turn horizontal vectors ``(*B, 2)`` to the left by an angle in radians, ``(*B)``."""
    (x, y), cos, sin = vectors.unbind(-1), angle.cos(), angle.sin()
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
