"""Importing recorded motion of any supported format as a clip of a character."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_mcp.envs.motions.capture.amc import read_asf_amc
from torchrl_mcp.envs.motions.capture.bvh import read_bvh
from torchrl_mcp.envs.motions.capture.deepmimic import read_deepmimic
from torchrl_mcp.envs.motions.capture.retarget import retarget
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.errors import MotionFormatError


class Import(NamedTuple):
    """A recorded motion and the lean of its rest pose.

    Args:
        clip: The motion.
        rest_lean: Greatest angle in degrees between the vertical and trunk or legs in the pose that was taken for
            standing upright: a bound on the error of leans in the clip. NaN for DeepMimic's files, which have the
            character's own joints.
    """

    clip: MotionClip
    rest_lean: float


def import_motion(path: str | Path, character: str, **options: Any) -> MotionClip:
    """Read a motion file as a clip of the humanoid or the biped: the clip of :func:`imported`.

    Args:
        path: The file.
        character: ``"humanoid"`` or ``"biped"``.
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
    joint_map: Mapping[str, str] | None = None,
    skip: int = 0,
    rest_frame: int | None = None,
    asf: str | Path | None = None,
) -> Import:
    """Read a motion file and retarget it to the humanoid or the biped.

    The suffix determines the format: ``.bvh``, ``.amc`` (with its ``.asf``), or ``.json`` or ``.txt`` for DeepMimic's
    files. Those have the joints of the two characters, in metres; of the options after ``rate``, only ``fps`` applies.

    Args:
        path: The file.
        character: ``"humanoid"`` or ``"biped"``.
        rate: Frames per second of the clip; the nearest rate that divides it into whole frames is used.
        fps: Frames per second of the file; None for the file's own rate, or 120 for ``.amc``.
        scale: Metres per unit of length; None for the file's own unit, or else a unit that fits the length of the legs.
        joint_map: See :func:`~torchrl_mcp.envs.motions.capture.anatomy.find_joints`.
        skip: Frames to leave out at the beginning.
        rest_frame: Frame, from 0 and before any are left out, in which the body stands upright, for files whose rest
            pose does not stand upright.
        asf: Skeleton of an ``.amc`` file; None for the one beside it.

    Raises:
        MotionFormatError: If the file cannot be used.
        ValueError: If an argument is out of range, or does not apply to the file.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".json", ".txt"):
        others = {"scale": scale, "joint_map": joint_map, "skip": skip or None, "rest_frame": rest_frame, "asf": asf}
        if given := [name for name, value in others.items() if value is not None]:
            raise ValueError(f"{given[0]} does not apply to {path}, a file of DeepMimic's: leave it out")
        return Import(read_deepmimic(path, character, rate=rate, fps=fps), math.nan)
    if suffix == ".bvh":
        source = read_bvh(path, fps=fps)
    elif suffix == ".amc":
        source = read_asf_amc(path, asf=asf, fps=fps)
    else:
        raise MotionFormatError(path, "ends in none of .bvh, .amc, .json and .txt: pass a motion, or rename it")
    clip, rest_lean = retarget(
        source, character, rate=rate, scale=scale, joint_map=joint_map, skip=skip, rest_frame=rest_frame
    )
    return Import(clip, rest_lean)
