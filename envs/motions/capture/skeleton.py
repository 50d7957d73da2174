"""Motion as stored in files: a skeleton of any shape, and the motion of its joints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self, overload

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.rotations import multiply, rotate

AXES = torch.eye(3, dtype=torch.float64)
"""Unit vectors x, y and z."""


class Pose(NamedTuple):
    """Positions and rotations of the joints, in the axes and the unit of the file.

    Attributes:
        positions: Positions of the joints, shape ``(*B, J, 3)``.
        rotations: Quaternions relative to the rest pose, shape ``(*B, J, 4)``.
    """

    positions: Tensor
    rotations: Tensor


@dataclass(frozen=True, eq=False)
class SourceMotion:
    """A recorded motion on its own skeleton.

    A joint turns and shifts all its descendants. In the rest pose no joint is turned.

    Args:
        path: The file.
        names: Names of the J joints, each after its parent.
        parents: Index of each joint's parent, -1 for the root.
        translations: Position of each joint in the frame of its parent, shape ``(T, J, 3)``.
        rotations: Rotation of each joint relative to its parent, shape ``(T, J, 4)``.
        fps: Frames per second.
        unit: Metres per unit of length, or None if unknown.
        lines: Line at which each frame begins; None for files that are no text.
        up: Axis that the format prescribes as the vertical, such as ``"z"``; None if it prescribes none.
    """

    path: Path
    names: Sequence[str]
    parents: Sequence[int]
    translations: Tensor
    rotations: Tensor
    fps: float
    unit: float | None
    lines: Sequence[int] | None = None
    up: str | None = None

    @property
    def rest(self) -> Pose:
        """The rest pose, with mean lengths over the motion, shapes ``(J, 3)`` and ``(J, 4)``."""
        return _forward_kinematics(self.parents, self.translations.mean(0), identities(len(self.names)))

    def poses(self) -> Pose:
        """The poses of all frames, shapes ``(T, J, 3)`` and ``(T, J, 4)``."""
        return _forward_kinematics(self.parents, self.translations, self.rotations)

    def pose(self, frame: int) -> Pose:
        """The pose in one frame, from 0, shapes ``(J, 3)`` and ``(J, 4)``.

        Raises:
            ValueError: If there is no such frame.
        """
        if not 0 <= frame < len(self.rotations):
            raise ValueError(f"rest_frame={frame} does not exist: pass one of 0..{len(self.rotations) - 1}")
        return _forward_kinematics(self.parents, self.translations[frame], self.rotations[frame])

    def without_first(self, frames: int) -> Self:
        """Leave out frames at the beginning.

        Raises:
            ValueError: If fewer than two frames would remain.
        """
        if not 0 <= frames <= len(self.rotations) - 2:
            raise ValueError(
                f"skip={frames} leaves less than two frames of {len(self.rotations)}: pass a smaller number"
            )
        return replace(
            self,
            translations=self.translations[frames:],
            rotations=self.rotations[frames:],
            lines=self.lines and self.lines[frames:],
        )

    def error(self, message: str, frame: int | None = None) -> MotionFormatError:
        """Return an error about this file, with the line of a frame, from 0."""
        return MotionFormatError(self.path, message, self.lines[frame] if self.lines and frame is not None else None)

    def ancestors(self, joint: int) -> list[int]:
        """Return the joint itself, its parent and so on up to the root."""
        chain = [joint]
        while self.parents[chain[-1]] >= 0:
            chain.append(self.parents[chain[-1]])
        return chain


@overload
def frame_rate(fps: float | None, stated: float) -> float: ...
@overload
def frame_rate(fps: float | None, stated: float | None) -> float | None: ...
def frame_rate(fps: float | None, stated: float | None) -> float | None:
    """Return the user's frames per second, or else the file's.

    Raises:
        ValueError: If the user's value cannot be a frame rate.
    """
    if fps is None:
        return stated
    if not 1.0 <= fps <= 10_000.0:
        raise ValueError(f"fps={fps} cannot be the frame rate of a recording: pass a number from 1 to 10000")
    return fps


def identities(*shape: int) -> Tensor:
    """Identity rotations, shape ``(*shape, 4)``."""
    return torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64).repeat(*shape, 1)


def _forward_kinematics(parents: Sequence[int], translations: Tensor, rotations: Tensor) -> Pose:
    positions: list[Tensor] = []
    turned: list[Tensor] = []
    for joint, parent in enumerate(parents):
        shift = translations[..., joint, :]
        turn = rotations[..., joint, :]
        if parent >= 0:
            shift = positions[parent] + rotate(turned[parent], shift)
            turn = multiply(turned[parent], turn)
        positions.append(shift)
        turned.append(turn)
    return Pose(torch.stack(positions, dim=-2), torch.stack(turned, dim=-2))
