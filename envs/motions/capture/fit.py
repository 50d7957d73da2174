"""Fitting a recorded motion to a character: of a skeleton, of a clip, or of the character's own joints."""

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.capture.anatomy import ARM, LEGS, SIDES, TRUNK, limb
from torchrl_mcp.envs.motions.capture.clips import as_source
from torchrl_mcp.envs.motions.capture.inverse_kinematics import solved
from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS, JointMotion, assembled, closed, require_frames
from torchrl_mcp.envs.motions.capture.key_bodies import key_map
from torchrl_mcp.envs.motions.capture.recording import record
from torchrl_mcp.envs.motions.capture.retarget import retarget
from torchrl_mcp.envs.motions.capture.skeleton import SourceMotion
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.errors import MisreadError, MotionFormatError

MISREAD = 30.0
"""Degrees beyond its limit that a joint reaches in most frames only if a recording is read wrongly."""

MIRRORED = "_mirrored"
"""End of the names of mirror images."""

RATE = 30.0
"""Frames per second of clips, unless told otherwise."""

CORRECTIONS = "correct the order of its rotations or the maps"

FRAME_0 = f"take its first frame as the standing pose (--rest-frame 0), which stays within the limits, or {CORRECTIONS}"
"""Remedy if it has been tried and works."""

REMEDIES = {
    "skeleton": f"take a frame that stands as the standing pose (--rest-frame), or {CORRECTIONS}",
    "clip": "correct the map of bodies (--bodies), or take another motion",
    "deepmimic": "reorder its quaternions, or pass --quaternion xyzw if they are x, y, z, w; angles are in radians",
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

    def mirrored(self) -> "Import":
        """Return the mirror image of the motion, for which the same holds."""
        return self._replace(clip=self.clip.mirrored())


def fit_skeleton(
    source: SourceMotion,
    character: str,
    *,
    rate: float | None = None,
    bodies: Mapping[str, str] | None = None,
    **skeletal: Any,
) -> Import:
    """Retarget the motion of a file; an error names frame 0 as the standing pose if that is the remedy."""
    require_map_applies(bodies, character)
    followers = {} if character in HUMANS else key_map(character, bodies)
    try:
        return _retargeted(source, character, rate, "skeleton", followers, **skeletal)
    except MisreadError as error:
        if "rest_frame" in skeletal:
            raise
        try:
            _retargeted(source, character, rate, "skeleton", followers, **skeletal, rest_frame=0)
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
        return fit_joints(source.path, character, closed(motion) if loop else motion, rate, kind)._replace(
            rest_lean=body.lean(), assumed=body.assumed
        )
    arms = [part for side in SIDES for part in limb(side, ARM) if limb(side, ARM)[0] in bodies]
    body = record(source, tuple(dict.fromkeys((*TRUNK, *LEGS, *arms, *bodies))), **skeletal)
    motion, missed = solved(body, character, bodies)
    missed = torch.rad2deg(missed)
    _require_within(source.path, missed, kind)
    fitted = fit_joints(source.path, character, closed(motion) if loop else motion, rate, kind)
    return fitted._replace(rest_lean=body.lean(), assumed=body.assumed, bodies=bodies, missed=missed)


def fit_clip(
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
            raise ValueError(f"{path} already is of character={character} and needs no map: leave the map out")
        if skip > len(clip.qpos) - 2:
            raise ValueError(f"skip={skip} leaves less than two frames of {len(clip.qpos)}: pass a smaller number")
        clip = clip.section(skip / clip.fps, clip.duration) if skip else clip
        if rate is not None:
            require_frames(clip.duration, rate)
            clip = clip.resampled(rate)
        return Import(clip)
    parts = key_map(clip.character, joint_map)
    followers = {} if character in HUMANS else key_map(character, bodies)
    followers = {part: body for part, body in followers.items() if part in parts}
    source = as_source(clip, path)
    loop = clip.loop and not skip
    return _retargeted(source, character, rate, kind, followers, loop=loop, joint_map=parts, skip=skip, scale=1.0)


def fit_joints(path: str | Path, character: str, motion: JointMotion, rate: float | None, kind: str) -> Import:
    """Make a clip of a motion, if limits leave most of it as it is."""
    clip, cut, ground = assembled(character, motion, rate=RATE if rate is None else rate)
    degrees = torch.rad2deg(cut)
    _require_within(path, degrees, kind)
    return Import(clip, cut=degrees, ground=ground)


def _require_within(path: str | Path, cut: Tensor, kind: str) -> None:
    """Check that the limits of the character's joints leave most frames roughly as they are."""
    misread = float((cut > MISREAD).double().mean())
    if misread > 0.5:
        finding = (
            f"in {100 * misread:.0f} % of its frames the limits of the character would cut a joint by more than "
            f"{MISREAD:g} degrees, and by up to {float(cut.max()):.0f}"
        )
        raise MisreadError(path, finding, REMEDIES[kind])


def require_map_applies(bodies: Mapping[str, str] | None, character: str) -> None:
    """Check that a map of bodies is not given for a character whose parts are known."""
    if bodies and character in HUMANS:
        raise ValueError(f"bodies do not apply to character={character}, whose parts are known: leave them out")
