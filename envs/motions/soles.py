"""Soles of feet that stand: flat, still, and no higher than the rest of the body."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.contacts import contact_points, support
from torchrl_mcp.envs.rotations import inverse, rotate

FLAT = math.radians(15)
"""Angle between the sole and the ground up to which a foot may stand; recordings tilt standing feet by up to this."""

STILL = 0.15
"""Speed in m/s up to which a foot may stand."""

LOW = 0.05
"""Height in metres above the lowest point of the body up to which a foot may stand."""


class Soles(NamedTuple):
    """The F feet of a clip over T frames.

    Attributes:
        heights: Height of the lowest point of each foot, shape ``(T, F)``, in metres.
        tilts: Angle between each sole and the ground, shape ``(T, F)``, in radians; 0 for feet of a single point.
        stands: Whether each foot stands, shape ``(T, F)``, bool.
    """

    heights: Tensor
    tilts: Tensor
    stands: Tensor

    def standing_height(self) -> float:
        """Median height in metres of the soles that stand, over the flattest third of them; NaN without any."""
        heights = self.heights[self.stands]
        tilts = self.tilts[self.stands]
        if not len(heights):
            return math.nan
        return float(heights[tilts <= tilts.quantile(1 / 3)].median())


def soles(clip: MotionClip, *, sinking: float = STILL) -> Soles:
    """Find out which feet stand.

    A foot stands while its sole is nearly as horizontal as in the character's rest pose, the foot is still, and no part
    of the body is clearly lower. Feet that push off, stand on their toes or lie on their backs do not stand.

    Args:
        clip: The clip.
        sinking: Vertical speed in m/s up to which a foot may stand.

    Raises:
        ValueError: If a foot has no shape that collides.
    """
    states = body_states(clip.character, clip.qpos, clip.qvel)
    feet = CHARACTERS[clip.character].feet
    points = [contact_points(clip.character, foot, states) for foot in feet]
    heights = torch.stack([point.positions[..., 2].amin(-1) for point in points], dim=-1)
    velocities = torch.stack([point.velocities.mean(1) for point in points], dim=1)
    single = torch.tensor([len(point.offsets) == 1 for point in points])
    tilts = _tilts(clip, states.orientations).masked_fill(single, 0.0)
    still = (velocities[..., :2].norm(dim=-1) < STILL) & (velocities[..., 2].abs() < sinking)
    low = heights < support(clip.character, states).heights.unsqueeze(-1) + LOW
    return Soles(heights, tilts, still & low & (tilts < FLAT))


def _tilts(clip: MotionClip, orientations: Tensor) -> Tensor:
    """Angle between each foot and its orientation in the rest pose, but for the heading, shape ``(T, F)``."""
    names = body_names(clip.character)
    model = character_model(clip.character)
    feet = [names.index(foot) for foot in CHARACTERS[clip.character].feet]
    rest = body_states(clip.character, torch.from_numpy(model.qpos0)[None], torch.zeros(1, model.nv).double())
    up = rest.orientations.new_tensor([0.0, 0.0, 1.0])
    normals = rotate(inverse(rest.orientations[:, feet]), up.expand(1, len(feet), 3))
    upward = rotate(orientations[:, feet], normals.expand(len(orientations), len(feet), 3))[..., 2]
    return upward.clamp(-1, 1).acos()
