"""What standing feet of a recording say about its ground."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_mcp.envs.motions.capture.joint_motion import speeds
from torchrl_mcp.envs.motions.capture.recording import Recording
from torchrl_mcp.envs.motions.capture.skeleton import AXES
from torchrl_mcp.envs.rotations import inverse, multiply, rotate, shortest

STILL = 0.15
"""Speed in m/s below which an ankle's foot is flat on the ground."""

STEEPEST = 0.05
"""Largest slope of a laboratory in metres per metre, three degrees."""

UP = AXES[2]


def from_straight(body: Recording, start: str, end: str) -> Tensor:
    """Rotation of a bone from pointing straight down in the standing pose, shape ``(T, 4)``."""
    standing = normalize(body.standing[end] - body.standing[start], dim=-1)
    return multiply(body.turns[start], shortest(-UP, standing).expand_as(body.turns[start]))


def flat(body: Recording, ankle: str) -> Tensor:
    """Rotation of a foot, ``(T, 4)``, with a constant turn that levels its sole in the median while it stands still."""
    foot = body.turns[ankle]
    still = foot[stands(body, ankle)]
    if not len(still):
        return foot
    normal = rotate(inverse(still), UP.expand(len(still), 3)).median(dim=0).values
    return multiply(foot, shortest(UP, normalize(normal, dim=-1)).expand_as(foot))


def slope(body: Recording) -> Tensor:
    r"""Slope of the laboratory's ground along x and y, shape ``(2,)``, in metres per metre.

    It is the slope of the plane through standing ankles at :math:`(p, z)`, relative to their mean, regularised towards
    flat ground:

    .. math:: s = (\langle p p^T \rangle + r^2 I)^{-1} \langle p z \rangle, \quad r = 0.3 \text{ m}
    """
    standing = torch.cat([body.positions[ankle][stands(body, ankle)] for ankle in ("right_ankle", "left_ankle")])
    if not len(standing):
        return torch.zeros(2, dtype=torch.float64)
    place, height = (standing - standing.mean(0)).split([2, 1], dim=-1)
    spread = place.mT @ place / len(place) + 0.3**2 * torch.eye(2, dtype=torch.float64)
    slope = torch.linalg.solve(spread, place.mT @ height / len(place)).squeeze(-1)
    return slope if slope.norm() < STEEPEST else torch.zeros_like(slope)  # steeper ground is stairs or a pit


def stands(body: Recording, ankle: str) -> Tensor:
    """Frames in which an ankle does not move, shape ``(T,)``, bool."""
    slow = speeds(body.positions[ankle], body.times) < STILL
    return torch.cat([slow[:1], slow])
