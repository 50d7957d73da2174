"""Detects strides and their phases from foot contacts, without the reference motion."""

from itertools import pairwise

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from torchrl_mcp.envs import PDCharacterEnv
from torchrl_mcp.envs.characters.falls import falling_geoms, lowest_points
from torchrl_mcp.envs.characters.kinematics import body_names

CLEARANCE = 0.003
"""A foot stands below this height in metres; the bounce after touch-down is lower."""

STEADY = 7
"""Odd number of control steps whose majority decides whether a foot stands, which removes flicker."""


class Feet:
    """Detects which feet stand on the ground.

    Args:
        env: The characters, of which only the shapes and poses of the feet are used.
    """

    def __init__(self, env: PDCharacterEnv) -> None:
        model = env.simulation.model
        feet = env.character.feet
        bodies = body_names(env.character.name)
        ignored = tuple(body for body in bodies if body not in feet)
        self._geoms, self._half_sizes, self._radii = falling_geoms(model, ignored, len(bodies))
        owners = torch.from_numpy(model.geom_bodyid[self._geoms.numpy()])
        self._shapes = [owners == model.body(foot).id for foot in feet]
        self._outputs = env.simulation.outputs

    def standing(self) -> Tensor:
        """Return whether the right and the left foot stand on the ground, ``(N, 2)``, bool."""
        heights = self._outputs["geom_xpos"][:, self._geoms, 2]
        vertical = self._outputs["geom_xmat"][:, self._geoms, 6:]
        down = lowest_points(heights, vertical, self._half_sizes, self._radii) < CLEARANCE
        return torch.stack([down[:, shapes].any(-1) for shapes in self._shapes], -1)


def stride_phases(standing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the phase of the stride, from 0 at a touch-down of the right foot to 1 at its next touch-down.

    A stride counts only if the left foot touches down exactly once during the stride.

    Args:
        standing: Whether the right and the left foot stand, one row per control step, ``(T, 2)``.

    Returns:
        Phases in [0, 1), ``(T,)``; NaN outside complete strides.
    """
    right = touch_downs(standing[:, 0])
    left = touch_downs(standing[:, 1])
    phases = np.full(len(standing), np.nan)
    for start, stop in pairwise(right.tolist()):
        if np.count_nonzero((left >= start) & (left < stop)) == 1:
            phases[start:stop] = np.arange(stop - start) / (stop - start)
    return phases


def touch_downs(standing: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the steps at which a foot begins to stand, after a majority vote over :data:`STEADY` steps.

    Args:
        standing: Whether the foot stands, ``(T,)``.
    """
    around = sliding_window_view(np.pad(standing, STEADY // 2, mode="edge"), STEADY)
    steady = around.sum(-1) > STEADY // 2
    return np.flatnonzero(steady[1:] & ~steady[:-1]) + 1
