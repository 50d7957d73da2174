"""A recorded human body in the character's axes and units."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_mcp.envs.motions.capture.anatomy import ARM, LEG, bones, find_joints
from torchrl_mcp.envs.motions.capture.joint_motion import LONGEST, TOP_SPEED, speeds
from torchrl_mcp.envs.motions.capture.skeleton import SourceMotion
from torchrl_mcp.envs.motions.capture.upright import stands_better, upright
from torchrl_mcp.envs.rotations import inverse, multiply

UNITS = (1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45)
"""Metres per unit of length: m, cm, mm, inches and CMU's unit. At most one of them fits the length of a leg."""

LEG_LENGTHS = (0.7, 1.0)
"""Range of metres from hip to ankle, for adults."""

SHORTEST_TRUNK = 0.1
"""Metres from hips to chest below which the line between them does not determine the lean of the trunk."""

SHORTEST_BONE = 0.06
"""Length of a bone of a limb, in lengths of the legs, below which it determines no direction."""


FRAME_0 = "frame 0 is the standing pose (--rest-frame 0), as the rest pose of the file does not stand"
"""What is assumed of a file whose bones lie along an axis."""


class Recording(NamedTuple):
    """Parts of a body, by name, in metres and the character's axes: x forward, y left, z up while it stands.

    Attributes:
        positions: Position of each part's beginning, shape ``(T, 3)``.
        turns: Rotation of each part from the standing pose, shape ``(T, 4)``.
        standing: Position of each part's beginning in the standing pose, shape ``(3,)``.
        times: Times of the frames in seconds, from 0, shape ``(T,)``.
        assumed: What was assumed about the standing pose against that of the file, as a sentence; or nothing.
    """

    positions: Mapping[str, Tensor]
    turns: Mapping[str, Tensor]
    standing: Mapping[str, Tensor]
    times: Tensor
    assumed: str

    def direction(self, start: str, end: str) -> Tensor:
        """Unit vectors from one part's beginning to another's, shape ``(T, 3)``."""
        return normalize(self.positions[end] - self.positions[start], dim=-1)

    def lean(self) -> float:
        """Greatest angle in degrees from the vertical in the pose that is taken for standing.

        It covers the trunk and the forward and backward lean of the legs' bones; many rest poses spread the legs.
        """
        middle = (self.standing["right_hip"] + self.standing["left_hip"]) / 2
        trunk = self.standing["chest"] - middle
        lines = [
            (self.standing[start] - self.standing[end]) * torch.tensor([1.0, 0.0, 1.0]) for start, end in bones(LEG)
        ]
        lines += [trunk] if trunk.norm() > SHORTEST_TRUNK else []
        upright = torch.stack([normalize(line, dim=-1)[2] for line in lines])
        return math.degrees(float(upright.clamp(-1, 1).acos().max()))

    def leg_length(self) -> float:
        """Mean length of thigh and shank together."""
        return _leg_length(self.positions)


def record(
    source: SourceMotion,
    parts: Sequence[str],
    *,
    scale: float | None = None,
    up: str | None = None,
    joint_map: Mapping[str, str] | None = None,
    skip: int = 0,
    rest_frame: int | None = None,
) -> Recording:
    """Find the parts of a body in a motion; see :func:`~torchrl_mcp.envs.motions.capture.retarget.retarget`."""
    joints = find_joints(source, parts, joint_map)
    whole = source
    source = source.without_first(skip)
    _require_end(source)
    pose = source.poses()
    taken = rest_frame is None and stands_better(whole, joints, whole.rest)
    rest_frame = 0 if taken else rest_frame
    rest = whole.rest if rest_frame is None else whole.pose(rest_frame)
    rest, axes, assumed = upright(source, joints, rest, pose, up=up, rest_frame=rest_frame, skip=skip)
    metres = _metres_per_unit(source, {part: pose.positions[:, joint] for part, joint in joints.items()}, scale)
    positions = metres * pose.positions @ axes.mT
    standing = metres * rest.positions @ axes.mT
    turns = multiply(pose.rotations, inverse(rest.rotations).expand_as(pose.rotations))
    turns = torch.cat([turns[..., :1], turns[..., 1:] @ axes.mT], dim=-1)
    recording = Recording(
        positions={part: positions[:, joint] for part, joint in joints.items()},
        turns={part: turns[:, joint] for part, joint in joints.items()},
        standing={part: standing[joint] for part, joint in joints.items()},
        times=torch.arange(len(source.rotations), dtype=torch.float64) / source.fps,
        assumed="; ".join(filter(None, [FRAME_0 if taken else "", assumed])),
    )
    _require_bones(source, recording)
    _require_no_jump(source, recording)
    return recording


def _require_end(source: SourceMotion) -> None:
    seconds = (len(source.rotations) - 1) / source.fps
    if seconds > LONGEST:
        raise source.error(f"lasts {seconds:.0f} s, more than an hour: correct the rate, or split it")


def _metres_per_unit(source: SourceMotion, positions: Mapping[str, Tensor], scale: float | None) -> float:
    """Return the user's unit, or else the one of the file or a usual one that fits the length of the legs."""
    if scale is not None:
        if not 0 < scale < math.inf:
            raise ValueError(
                f"scale={scale} must be a unit of length: pass metres per unit, such as 0.01 for centimetres"
            )
        return scale
    length, (low, high) = _leg_length(positions), LEG_LENGTHS
    fitting = [unit for unit in UNITS if low <= unit * length <= high]
    metres = source.unit or (fitting[0] if fitting else 1.0)
    if not low <= metres * length <= high:
        raise source.error(
            f"from hip to ankle it measures {length:.4g} units, which at {metres:.4g} m each are "
            f"{metres * length:.3g} m, but should be {low} to {high} m: pass the scale, in metres per unit"
        )
    return metres


def _leg_length(positions: Mapping[str, Tensor]) -> float:
    lengths = [torch.linalg.vector_norm(positions[end] - positions[start], dim=-1) for start, end in bones(LEG)]
    return float(torch.stack(lengths).sum(0).mean() / 2)


def _require_bones(source: SourceMotion, recording: Recording) -> None:
    """Check that all limbs have a length, and thus a direction."""
    shortest = SHORTEST_BONE * recording.leg_length()
    for start, end in (*bones(LEG), *bones(ARM)):
        if start in recording.positions:
            lengths = torch.linalg.vector_norm(recording.positions[end] - recording.positions[start], dim=-1)
            if not lengths.min() > shortest:
                message = (
                    f"{start} and {end} come closer than {100 * shortest:.3g} cm: name the right joints with a map"
                )
                raise source.error(message, int(lengths.argmin()))


def _require_no_jump(source: SourceMotion, recording: Recording) -> None:
    """Check that the recording does not jump, as it does if its first frame is a pose for calibration."""
    for part, positions in recording.positions.items():
        fast = speeds(positions, recording.times) > TOP_SPEED
        if fast.any():
            frame = int(fast.nonzero()[0]) + 1
            first = "leave out the first, which seems to be a T-pose (skip)"
            other = "cut the file there, or correct the order of its rotations"
            raise source.error(
                f"{part} jumps between frames {frame} and {frame + 1}, faster than {TOP_SPEED:g} m/s at "
                f"{source.fps:g} frames/s: {first if frame == 1 else other}",
                frame,
            )
