"""Importing recorded motion of any supported format as a clip of a character."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.amc import read_asf_amc
from torchrl_mcp.envs.motions.capture.anatomy import ARM, LEGS, SIDES, TRUNK, limb
from torchrl_mcp.envs.motions.capture.bvh import read_bvh
from torchrl_mcp.envs.motions.capture.clips import as_source
from torchrl_mcp.envs.motions.capture.deepmimic import read_deepmimic
from torchrl_mcp.envs.motions.capture.inverse_kinematics import solved
from torchrl_mcp.envs.motions.capture.joint_motion import (
    HUMANS,
    QUATERNIONS,
    JointMotion,
    assembled,
    closed,
    require_frames,
)
from torchrl_mcp.envs.motions.capture.key_bodies import key_map
from torchrl_mcp.envs.motions.capture.qpos import read_qpos
from torchrl_mcp.envs.motions.capture.recording import record
from torchrl_mcp.envs.motions.capture.retarget import retarget
from torchrl_mcp.envs.motions.capture.skeleton import SourceMotion
from torchrl_mcp.envs.motions.capture.smpl import is_smpl, read_smpl
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.errors import MisreadError, MotionFormatError

MISREAD = 30.0
"""Degrees beyond its limit that a joint reaches in most frames only if a recording is read wrongly."""

RATE = 30.0
"""Frames per second of clips, unless told otherwise."""

KINDS = {
    "skeleton": "a skeleton's motion",
    "deepmimic": "a file of DeepMimic's",
    "clip": "a clip",
    "qpos": "states of a character",
}
"""Kinds of files, as errors call them."""

OPTIONS = {
    "skeleton": ("scale", "up", "joint_map", "skip", "rest_frame", "asf", "body_model", "bodies"),
    "deepmimic": ("quaternion", "bodies"),
    "clip": ("joint_map", "skip", "bodies"),
    "qpos": ("quaternion", "joints"),
}
"""Options that apply to a kind, beside the frame rates."""

UNPICKLE = (
    "load it with the code of its data set (AIST++: AISTDataset.load_motion of aist_plusplus.loader; SMPL: pickle.load)"
    " and write poses in radians, trans in metres and fps to an .npz with numpy.savez (AIST++: poses=smpl_poses, "
    "trans=smpl_trans / smpl_scaling, fps=60)"
)
"""How to convert the pickles in which motions of SMPL's bodies are shared."""

CORRECTIONS = "correct the order of its rotations or the maps"

FRAME_0 = f"take its first frame as the standing pose (--rest-frame 0), which stays within the limits, or {CORRECTIONS}"
"""Remedy if it has been tried and works."""

REMEDIES = {
    "skeleton": f"take a frame that stands as the standing pose (--rest-frame), or {CORRECTIONS}",
    "clip": "correct the map of bodies (--bodies), or take another motion",
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
        bodies: Bodies of the character by part of the recorded person, if inverse kinematics fitted them.
        missed: Greatest angle in degrees by which a bone of them misses its direction in each frame, shape ``(T,)``.
        ground: What was assumed about the ground other than that feet stand on it and it is flat; or nothing.
    """

    clip: MotionClip
    rest_lean: float = math.nan
    cut: Tensor = torch.empty(0)
    assumed: str = ""
    bodies: Mapping[str, str] = MappingProxyType({})
    missed: Tensor = torch.empty(0)
    ground: str = ""


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
    rate: float | None = None,
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
    bodies: Mapping[str, str] | None = None,
) -> Import:
    """Read a motion file and fit it to a character.

    The suffix determines the format. ``.bvh``, ``.amc`` (with its ``.asf``) and ``.npz`` of SMPL's bodies hold a
    person's skeleton. ``.json`` and ``.txt`` hold the joints of DeepMimic's characters, in metres. A clip in ``.npz``
    holds a character's motion, and stays a cycle if it is one. Humanoid and biped take over the turns of a person's
    joints, see :func:`~torchrl_mcp.envs.motions.capture.retarget.retarget`; any other character follows by inverse
    kinematics, see :func:`~torchrl_mcp.envs.motions.capture.inverse_kinematics.solved`. ``.csv`` and other ``.npz``
    hold ``qpos`` of the character, see :func:`~torchrl_mcp.envs.motions.capture.qpos.read_qpos`.

    Args:
        path: The file.
        character: Name of the character.
        rate: Frames per second of the clip; the nearest rate that divides it into whole frames is used. None for 30,
            or for those of a clip of the same character.
        fps: Frames per second of the file; None for the file's own rate, or 120 for ``.amc``. A clip has its own.
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
        bodies: Bodies of the character by part of a person, for inverse kinematics, see
            :func:`~torchrl_mcp.envs.motions.capture.key_bodies.key_map`.

    Raises:
        MotionFormatError: If the file cannot be used.
        ValueError: If an argument is out of range, or does not apply to the file.
        ImportError: If inverse kinematics needs a package that is not installed.
    """
    kind = _kind(path)
    skeletal: dict[str, Any] = {
        "scale": scale,
        "up": up,
        "joint_map": joint_map,
        "skip": skip,
        "rest_frame": rest_frame,
    }
    others = {"asf": asf, "body_model": body_model, "quaternion": quaternion, "joints": joints, "bodies": bodies}
    _require_applicable(path, kind, skeletal | others | {"skip": skip or None})
    if bodies and character in HUMANS:
        raise ValueError(f"bodies do not apply to character={character}, whose parts are known: leave them out")
    match kind:
        case "skeleton":
            source = _skeleton(path, fps=fps, asf=asf, body_model=body_model)
            followers = {} if character in HUMANS else key_map(character, bodies)
            return _of_skeleton(source, character, rate, followers, **skeletal)
        case "clip":
            if fps is not None:
                raise ValueError(f"fps does not apply to {path}, {KINDS[kind]}, which has its own: leave it out")
            return _of_clip(path, MotionClip.load(path), character, rate, kind, bodies, joint_map=joint_map, skip=skip)
        case "deepmimic":
            human = character if character in HUMANS else "humanoid"
            motion = read_deepmimic(path, fps=fps, quaternion=quaternion or "wxyz")
            found = _assembled(path, human, motion, rate, kind)
            return found if character == human else _of_clip(path, found.clip, character, rate, kind, bodies)
    motion = read_qpos(path, character, fps=fps, quaternion=quaternion, joints=joints)
    return _assembled(path, character, motion, rate, kind)


def _of_skeleton(
    source: SourceMotion, character: str, rate: float | None, bodies: Mapping[str, str], **skeletal: Any
) -> Import:
    """Retarget the motion of a file; an error names frame 0 as the standing pose if that is the remedy."""
    try:
        return _retargeted(source, character, rate, "skeleton", bodies, **skeletal)
    except MisreadError as error:
        if skeletal["rest_frame"] is not None:
            raise
        try:
            _retargeted(source, character, rate, "skeleton", bodies, **skeletal | {"rest_frame": 0})
        except MotionFormatError:
            raise error from None
        raise MisreadError(source.path, error.finding, FRAME_0) from error


def _retargeted(
    source: SourceMotion,
    character: str,
    rate: float | None,
    kind: str,
    bodies: Mapping[str, str],
    *,
    loop: bool = False,
    **skeletal: Any,
) -> Import:
    """Retarget the motion of a skeleton, with a map of bodies for inverse kinematics."""
    if character in HUMANS:
        motion, body = retarget(source, character, **skeletal)
        return _assembled(source.path, character, closed(motion) if loop else motion, rate, kind)._replace(
            rest_lean=body.lean(), assumed=body.assumed
        )
    arms = [part for side in SIDES for part in limb(side, ARM) if limb(side, ARM)[0] in bodies]
    body = record(source, tuple(dict.fromkeys((*TRUNK, *LEGS, *arms, *bodies))), **skeletal)
    motion, missed = solved(body, character, bodies)
    missed = torch.rad2deg(missed)
    _require_within(source.path, missed, kind)
    found = _assembled(source.path, character, closed(motion) if loop else motion, rate, kind)
    return found._replace(rest_lean=body.lean(), assumed=body.assumed, bodies=bodies, missed=missed)


def _of_clip(
    path: str | Path,
    clip: MotionClip,
    character: str,
    rate: float | None,
    kind: str,
    bodies: Mapping[str, str] | None,
    *,
    joint_map: Mapping[str, str] | None = None,
    skip: int = 0,
) -> Import:
    """Retarget a clip, unless it is of the same character. A cycle stays one, if no frames are left out."""
    if clip.character == character:
        if joint_map or bodies:
            raise ValueError(f"{path} is of character={character} already, and needs no map: leave it out")
        clip = clip.section(skip / clip.fps, clip.duration) if skip else clip
        if rate is not None:
            require_frames(clip.duration, rate)
            clip = clip.resampled(rate)
        return Import(clip)
    parts = key_map(clip.character, joint_map)
    followers = {} if character in HUMANS else key_map(character, bodies)
    followers = {part: body for part, body in followers.items() if part in parts}
    source, loop = as_source(clip, path), clip.loop and not skip
    return _retargeted(source, character, rate, kind, followers, loop=loop, joint_map=parts, skip=skip, scale=1.0)


def _assembled(path: str | Path, character: str, motion: JointMotion, rate: float | None, kind: str) -> Import:
    """Make a clip of a motion, if limits leave most of it as it is."""
    clip, cut, ground = assembled(character, motion, rate=RATE if rate is None else rate)
    degrees = torch.rad2deg(cut)
    _require_within(path, degrees, kind)
    return Import(clip, cut=degrees, ground=ground)


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
            archive = Archive(path)
            return "clip" if "character" in archive.names else "skeleton" if is_smpl(archive) else "qpos"
        case ".pkl" | ".pickle":
            raise MotionFormatError(path, f"is a pickle, whose reading can run any code: {UNPICKLE}")
    raise MotionFormatError(path, "ends in none of .bvh, .amc, .npz, .csv, .json and .txt: convert it to one of them")


def _require_applicable(path: str | Path, kind: str, options: Mapping[str, Any]) -> None:
    """Check that the options that are given apply to a kind of file."""
    if wrong := [name for name, value in options.items() if value is not None and name not in OPTIONS[kind]]:
        raise ValueError(f"{wrong[0]} does not apply to {path}, {KINDS[kind]}: leave it out")
    if options["quaternion"] not in (None, *QUATERNIONS):
        raise ValueError(f"quaternion={options['quaternion']!r} is not an order: pass one of {', '.join(QUATERNIONS)}")


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
        finding = (
            f"in {100 * misread:.0f} % of its frames the limits of the character would cut a joint by more than "
            f"{MISREAD:g} degrees, and by up to {float(cut.max()):.0f}"
        )
        raise MisreadError(path, finding, REMEDIES[kind])
