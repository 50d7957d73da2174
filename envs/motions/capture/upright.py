"""The vertical of a recording, and the pose in which its body stands upright."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_mcp.envs.motions.capture.anatomy import ARM, LEG, SIDES, bones
from torchrl_mcp.envs.motions.capture.skeleton import AXES, Pose, SourceMotion
from torchrl_mcp.envs.rotations import multiply, rotate, shortest

VERTICALS = {
    f"{sign}{name}": axis * float(f"{sign}1") for sign in ("", "-") for name, axis in zip("xyz", AXES, strict=True)
}
"""Directions that can point up in a file, by name: ``"z"``, ``"-y"``, ..."""

ROUGHLY = math.cos(math.radians(60))
CLOSELY = math.cos(math.radians(10))
"""Cosines of the angles up to which legs and trunk point along an axis, and up to which they are meant to be on it."""

UPRIGHT = math.radians(20)
"""Angle to an axis up to which trunk and bones of the legs of a pose stand upright beyond doubt."""

SHORTEST_TRUNK = 0.12
"""Length from hips to chest, in lengths of the legs, below which it determines no direction."""

GROUND = 0.35
"""Height of standing ankles above or below the origin, in lengths of the legs, that shows where the ground is."""


class Standing(NamedTuple):
    """A pose in which a body stands upright.

    Attributes:
        rest: The pose in the axes of the file.
        axes: Forward, left and up in the axes of the file, the rows of a rotation matrix, shape ``(3, 3)``.
        assumed: What was assumed against the rest pose of the file, as a sentence; or nothing.
    """

    rest: Pose
    axes: Tensor
    assumed: str


def upright(
    source: SourceMotion,
    joints: Mapping[str, int],
    rest: Pose,
    frames: Pose,
    *,
    up: str | None = None,
    rest_frame: int | None = None,
    skip: int = 0,
) -> Standing:
    """Find the vertical of a motion, and turn its rest pose to stand along it.

    The vertical is the axis that the format prescribes, or else the one along which the body stands in the rest pose.
    If no frame stands along it, a constant rotation is between rest pose and motion: the vertical is then the axis
    along which most frames stand with their feet near the origin.

    Args:
        source: The motion.
        joints: Index of a joint for each part of the body.
        rest: The rest pose, or frame ``rest_frame``.
        frames: The poses of the motion.
        up: The vertical, one of :data:`VERTICALS`; None to find it.
        rest_frame: Number of the frame that the user declared to stand upright, or None.
        skip: Number of the first of the frames, for an error.

    Raises:
        MotionFormatError: If the body does not stand in the rest pose, or along no axis in the motion.
        ValueError: If there is no such axis.
    """
    if up is not None and up not in VERTICALS:
        raise ValueError(f"up={up!r} must be an axis: pass one of {', '.join(VERTICALS)}")
    moving = _parts(joints, frames)
    body = _body(_parts(joints, rest))
    if body is None:
        named = "its rest pose" if rest_frame is None else f"frame {rest_frame}"
        raise source.error(
            f"{named} does not stand with the legs straight and the arms down or to the sides: "
            f"{_remedy(moving, skip)}name the joints with a map (--map)"
        )
    nearest = _nearest(body)
    start = VERTICALS[nearest]
    chosen = up or nearest
    if rest_frame is None:
        chosen = up or _vertical(source, moving, source.up or nearest)
        if body @ start < CLOSELY and _closely(moving, VERTICALS[chosen]):
            start = body
    turn = shortest(start, VERTICALS[chosen])
    rest = Pose(rotate(turn.expand(len(rest.positions), 4), rest.positions), multiply(turn, rest.rotations))
    degrees = math.degrees(2 * float(turn[0].clamp(-1, 1).acos()))
    assumed = degrees > 0.1 and chosen not in (up, source.up)
    note = f"{chosen} points up, and the rest pose is turned by {degrees:.0f} degrees to stand along it"
    return Standing(rest, _axes(_parts(joints, rest), VERTICALS[chosen]), note if assumed else "")


def _axes(rest: Mapping[str, Tensor], up: Tensor) -> Tensor:
    """Forward, left and up of a pose that stands, the rows of a rotation matrix, shape ``(3, 3)``."""
    across = rest["left_hip"] - rest["right_hip"]
    left = normalize(across - (across @ up) * up, dim=-1)
    return torch.stack([torch.linalg.cross(left, up), left, up])


def _parts(joints: Mapping[str, int], pose: Pose) -> dict[str, Tensor]:
    return {part: pose.positions[..., joint, :] for part, joint in joints.items()}


def _middle(parts: Mapping[str, Tensor], joint: str) -> Tensor:
    left, right = (parts[f"{side}_{joint}"] for side in SIDES)
    return (left + right) / 2


def _directions(parts: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Unit vectors from the ankles to the hips and from there to the chest, shapes ``(*B, 3)``."""
    legs = _middle(parts, "hip") - _middle(parts, "ankle")
    trunk = parts["chest"] - _middle(parts, "hip")
    short = trunk.norm(dim=-1, keepdim=True) < SHORTEST_TRUNK * legs.norm(dim=-1, keepdim=True)
    return normalize(legs, dim=-1), normalize(torch.where(short, legs, trunk), dim=-1)


def stands_better(source: SourceMotion, joints: Mapping[str, int], rest: Pose) -> bool:
    """Whether frame 0 of a motion stands upright, and its rest pose does not stand."""
    frame = _parts(joints, source.pose(0))
    return _body(_parts(joints, rest)) is None and _body(frame) is not None and bool(_lean(frame) < UPRIGHT)


def _body(rest: Mapping[str, Tensor]) -> Tensor | None:
    """Direction upwards of legs and trunk in a pose, shape ``(3,)``; None if it does not stand."""
    legs, trunk = _directions(rest)
    axis = VERTICALS[_nearest(trunk)]
    along = axis if trunk @ axis > 0.9 else trunk
    lower, arms = (
        [float(normalize(rest[end] - rest[start], dim=-1) @ along) for start, end in bones(limb) if start in rest]
        for limb in (LEG, ARM)
    )
    across = torch.linalg.cross(rest["left_hip"] - rest["right_hip"], along)
    stands = max(lower) <= -ROUGHLY and max(arms, default=0.0) <= 0.9 and bool(across.any())
    return normalize(legs + trunk, dim=-1) if stands else None


def _lean(parts: Mapping[str, Tensor]) -> Tensor:
    """Greatest angle between trunk or bones of the legs and the axis nearest to their direction, shape ``(*B)``."""
    legs, trunk = _directions(parts)
    direction = legs + trunk
    nearest = direction.abs().argmax(-1, keepdim=True)
    axis = torch.zeros_like(direction).scatter(-1, nearest, direction.gather(-1, nearest).sign())
    lines = [trunk, *(normalize(parts[start] - parts[end], dim=-1) for start, end in bones(LEG))]
    return torch.stack([(line * axis).sum(-1) for line in lines]).amin(0).clamp(-1, 1).acos()


def _remedy(frames: Mapping[str, Tensor], skip: int) -> str:
    """The frame that stands straightest, as the beginning of an instruction; nothing if none stands."""
    straightest = int(_lean(frames).argmin())
    if _body({part: places[straightest] for part, places in frames.items()}) is None:
        return ""
    return f"take one that does instead, the straightest (--rest-frame {skip + straightest}), or "


def _nearest(direction: Tensor) -> str:
    return max(VERTICALS, key=lambda name: float(direction @ VERTICALS[name]))


def _vertical(source: SourceMotion, frames: Mapping[str, Tensor], stated: str) -> str:
    """Choose the stated axis if any frame stands along it, or else the one along which most frames stand."""
    if _stands(frames, VERTICALS[stated]).any():
        return stated
    legs = (_middle(frames, "hip") - _middle(frames, "ankle")).norm(dim=-1).mean()
    shares = {}
    for name, axis in VERTICALS.items():
        stands = _stands(frames, axis)
        heights = torch.minimum(frames["left_ankle"] @ axis, frames["right_ankle"] @ axis)[stands]
        on_ground = len(heights) and float(heights.median().abs()) < GROUND * legs
        shares[name] = float(stands.double().mean()) if on_ground else 0.0
    chosen = max(shares, key=lambda name: shares[name])
    if shares[chosen] <= 0.5:
        raise source.error(
            f"its body does not stand in any frame if {stated} points up, and other axes are no better: "
            f"pass the axis that points up, such as --up {stated}, or a frame that stands (--rest-frame)"
        )
    return chosen


def _stands(frames: Mapping[str, Tensor], axis: Tensor) -> Tensor:
    """Frames in which legs and trunk point roughly along an axis, shape ``(T,)``, bool."""
    legs, trunk = _directions(frames)
    return (legs @ axis > ROUGHLY) & (trunk @ axis > ROUGHLY)


def _closely(frames: Mapping[str, Tensor], axis: Tensor) -> bool:
    """Whether legs and trunk together point along an axis in most frames that stand."""
    legs, trunk = _directions(frames)
    lean = (normalize(legs + trunk, dim=-1) @ axis)[_stands(frames, axis)]
    return bool(len(lean) and lean.median() > CLOSELY)
