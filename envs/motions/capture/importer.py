"""Importing recorded motion of any supported format as a clip of a character."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.amc import read_asf_amc
from torchrl_mcp.envs.motions.capture.bvh import read_bvh
from torchrl_mcp.envs.motions.capture.deepmimic import read_deepmimic
from torchrl_mcp.envs.motions.capture.joint_motion import QUATERNIONS, assembled, require_human
from torchrl_mcp.envs.motions.capture.qpos import read_qpos
from torchrl_mcp.envs.motions.capture.retarget import retarget
from torchrl_mcp.envs.motions.capture.skeleton import SourceMotion
from torchrl_mcp.envs.motions.capture.smpl import is_smpl, read_smpl
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.errors import MotionFormatError

MISREAD = 30.0
"""Degrees beyond its limit that a joint reaches in most frames only if a recording is read wrongly."""

KINDS = {"skeleton": "a skeleton's motion", "deepmimic": "a file of DeepMimic's", "qpos": "states of a character"}
"""Kinds of files, as errors call them."""

OPTIONS = {
    "skeleton": ("scale", "up", "joint_map", "skip", "rest_frame", "asf", "body_model"),
    "deepmimic": ("quaternion",),
    "qpos": ("quaternion", "joints"),
}
"""Options that apply to a kind, beside the frame rates."""

REMEDIES = {
    "skeleton": "correct the order of its rotations or the map, or give another rest frame",
    "deepmimic": "reorder its quaternions, or say that they are x, y, z, w (--quaternion xyzw); angles are in radians",
    "qpos": "correct the order of its joints (--joints) or of its quaternions (--quaternion); angles are in radians",
}


class Import(NamedTuple):
    """A recorded motion, and what was done to it.

    Args:
        clip: The motion.
        rest_lean: Greatest angle in degrees between the vertical and trunk or legs in the pose that was taken for
            standing upright: a bound on the error of leans in the clip. NaN for files of the character's own joints.
        cut: Greatest angle in degrees by which a joint of each frame of the file was cut to the character's limits,
            shape ``(T,)``; empty for clips.
        assumed: What was assumed about the standing pose against that of the file; or nothing.
    """

    clip: MotionClip
    rest_lean: float = math.nan
    cut: Tensor = torch.empty(0)
    assumed: str = ""


def import_motion(path: str | Path, character: str, **options: Any) -> MotionClip:
    """Read a motion file as a clip of a character: the clip of :func:`imported`.

    Args:
        path: The file.
        character: Name of the character.
        **options: Options of :func:`imported`.
    """
    return imported(path, character, **options).clip


def imported(
    path: str | Path,
    character: str,
    *,
    rate: float = 30.0,
    fps: float | None = None,
    scale: float | None = None,
    up: str | None = None,
    joint_map: Mapping[str, str] | None = None,
    skip: int = 0,
    rest_frame: int | None = None,
    asf: str | Path | None = None,
    body_model: str | Path | None = None,
    quaternion: str | None = None,
    joints: Sequence[str] | None = None,
) -> Import:
    """Read a motion file and fit it to a character.

    The suffix determines the format. ``.bvh``, ``.amc`` (with its ``.asf``) and ``.npz`` of SMPL's bodies hold a
    person's skeleton, which is retargeted to the humanoid or the biped. ``.json`` and ``.txt`` hold the joints of
    DeepMimic's characters, in metres, for the humanoid or the biped. ``.csv`` and other ``.npz`` hold ``qpos`` of any
    character, see :func:`~torchrl_mcp.envs.motions.capture.qpos.read_qpos`.

    Args:
        path: The file.
        character: Name of the character.
        rate: Frames per second of the clip; the nearest rate that divides it into whole frames is used.
        fps: Frames per second of the file; None for the file's own rate, or 120 for ``.amc``.
        scale: Metres per unit of length; None for the file's own unit, or else a unit that fits the length of the legs.
        up: Axis of a skeleton's file that points up, such as ``"z"`` or ``"-y"``; None to find it, see
            :func:`~torchrl_mcp.envs.motions.capture.upright.upright`.
        joint_map: See :func:`~torchrl_mcp.envs.motions.capture.anatomy.find_joints`.
        skip: Frames to leave out at the beginning.
        rest_frame: Frame, from 0 and before any are left out, in which the body stands upright, for files whose rest
            pose does not stand upright.
        asf: Skeleton of an ``.amc`` file; None for the one beside it.
        body_model: Body model of a file of SMPL's bodies; None for the mean body.
        quaternion: Order of the components of quaternions, ``"wxyz"`` or ``"xyzw"``; None for ``wxyz`` in DeepMimic's
            files, and in ``qpos`` for the order in which the root is upright.
        joints: Joints in the order of the columns of ``qpos``; None for the names in the file, or else the order of the
            character's model.

    Raises:
        MotionFormatError: If the file cannot be used.
        ValueError: If an argument is out of range, or does not apply to the file.
    """
    kind, rest_lean, assumed = _kind(path), math.nan, ""
    skeletal: dict[str, Any] = {
        "scale": scale,
        "up": up,
        "joint_map": joint_map,
        "skip": skip,
        "rest_frame": rest_frame,
    }
    others = {"asf": asf, "body_model": body_model, "quaternion": quaternion, "joints": joints}
    _require_applicable(path, kind, skeletal | others | {"skip": skip or None})
    match kind:
        case "skeleton":
            source = _skeleton(path, fps=fps, asf=asf, body_model=body_model)
            motion, body = retarget(source, character, **skeletal)
            rest_lean, assumed = body.lean(), body.assumed
        case "deepmimic":
            require_human(character)
            motion = read_deepmimic(path, fps=fps, quaternion=quaternion or "wxyz")
        case _:
            motion = read_qpos(path, character, fps=fps, quaternion=quaternion, joints=joints)
    clip, cut = assembled(character, motion, rate=rate)
    degrees = torch.rad2deg(cut)
    _require_within(path, degrees, kind)
    return Import(clip, rest_lean, degrees, assumed)


def _kind(path: str | Path) -> str:
    """What a file holds, by its suffix and the names of its arrays: one of :data:`KINDS`."""
    match Path(path).suffix.lower():
        case ".bvh" | ".amc":
            return "skeleton"
        case ".json" | ".txt":
            return "deepmimic"
        case ".csv":
            return "qpos"
        case ".npz":
            return "skeleton" if is_smpl(Archive(path)) else "qpos"
    raise MotionFormatError(path, "ends in none of .bvh, .amc, .npz, .csv, .json and .txt: pass a motion, or rename it")


def _require_applicable(path: str | Path, kind: str, options: Mapping[str, Any]) -> None:
    """Check that the options that are given apply to a kind of file."""
    if wrong := [name for name, value in options.items() if value is not None and name not in OPTIONS[kind]]:
        raise ValueError(f"{wrong[0]} does not apply to {path}, {KINDS[kind]}: leave it out")
    if options["quaternion"] not in (None, *QUATERNIONS):
        raise ValueError(f"quaternion={options['quaternion']!r} is no order: pass one of {', '.join(QUATERNIONS)}")


def _skeleton(
    path: str | Path, *, fps: float | None, asf: str | Path | None, body_model: str | Path | None
) -> SourceMotion:
    """Read the motion of a skeleton."""
    match Path(path).suffix.lower():
        case ".bvh":
            return read_bvh(path, fps=fps)
        case ".amc":
            return read_asf_amc(path, asf=asf, fps=fps)
    return read_smpl(path, body_model=body_model, fps=fps)


def _require_within(path: str | Path, cut: Tensor, kind: str) -> None:
    """Check that the limits of the character's joints leave most frames roughly as they are."""
    misread = float((cut > MISREAD).double().mean())
    if misread > 0.5:
        raise MotionFormatError(
            path,
            f"in {100 * misread:.0f} % of its frames the limits of the character would cut a joint by more than "
            f"{MISREAD:g} degrees, and by up to {float(cut.max()):.0f}: {REMEDIES[kind]}",
        )
