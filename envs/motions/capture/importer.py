"""Importing recorded motion as a clip of a character: a function for each format, and one for all."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, Unpack

from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.amc import read_asf_amc
from torchrl_mcp.envs.motions.capture.bvh import read_bvh
from torchrl_mcp.envs.motions.capture.deepmimic import read_deepmimic
from torchrl_mcp.envs.motions.capture.fit import Import, fit_clip, fit_joints, fit_skeleton, require_map_applies
from torchrl_mcp.envs.motions.capture.joint_motion import (
    HUMANS,
    QUATERNIONS,
)
from torchrl_mcp.envs.motions.capture.qpos import read_qpos
from torchrl_mcp.envs.motions.capture.smpl import is_smpl, read_smpl
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.errors import MotionFormatError

UNPICKLE = (
    "load it with the code of its data set (AIST++: AISTDataset.load_motion of aist_plusplus.loader; SMPL: pickle.load)"
    " and write poses in radians, trans in metres and fps to an .npz with numpy.savez (AIST++: poses=smpl_poses, "
    "trans=smpl_trans / smpl_scaling, fps=60)"
)
"""How to convert the pickles in which motions of SMPL's bodies are shared."""


def import_motion(path: str | Path, character: str, **options: Any) -> MotionClip:
    """Read a motion file as a clip of a character: the clip of :func:`imported`.

    Args:
        path: The file.
        character: Name of the character.
        **options: Options of :func:`imported`.
    """
    return imported(path, character, **options).clip


def imported(path: str | Path, character: str, **options: Any) -> Import:
    """Read a motion file and fit it to a character.

    The suffix, and for ``.npz`` the content, determines the format, and thereby the function: see :data:`FORMATS`.
    Humanoid and biped take over the turns of a person's joints, see
    :func:`~torchrl_mcp.envs.motions.capture.retarget.retarget`; any other character follows by inverse kinematics, see
    :func:`~torchrl_mcp.envs.motions.capture.inverse_kinematics.solved`.

    Args:
        path: The file.
        character: Name of the character.
        **options: Options of the format's function. None stands for the default.

    Raises:
        MotionFormatError: If the file cannot be used.
        ValueError: If an option is out of range, or does not apply to the file.
        ImportError: If inverse kinematics needs a package that is not installed.
    """
    read, words = FORMATS[_format(path)]
    given = {name: value for name, value in options.items() if value is not None}
    if wrong := [name for name in given if name not in applicable(read)]:
        raise ValueError(f"{wrong[0]} does not apply to {path}, {words}: leave it out")
    return read(path, character, **given)


def applicable(read: Callable[..., Import]) -> set[str]:
    """Return the names of the options of a format's function."""
    named = {*inspect.signature(read).parameters} - {"path", "character", "skeletal"}
    return named | ({*Skeletal.__annotations__} if "skeletal" in inspect.signature(read).parameters else set())


class Skeletal(TypedDict, total=False):
    """Options of all files with a person's skeleton.

    Attributes:
        rate: Frames per second of the clip; the nearest rate that divides it into whole frames is used. Default: 30.
        scale: Metres per unit of length. Default: the file's own unit, or else a unit that fits the length of the legs.
        up: Axis of the file that points up, such as ``"z"`` or ``"-y"``. Default: it is found, see
            :func:`~torchrl_mcp.envs.motions.capture.upright.upright`.
        joint_map: See :func:`~torchrl_mcp.envs.motions.capture.anatomy.find_joints`.
        skip: Frames to leave out at the beginning.
        rest_frame: Frame, from 0 and before any are left out, in which the body stands upright, for files whose rest
            pose does not stand upright.
        bodies: Bodies of the character by part of a person, for inverse kinematics, see
            :func:`~torchrl_mcp.envs.motions.capture.key_bodies.key_map`.
    """

    rate: float
    scale: float
    up: str
    joint_map: Mapping[str, str]
    skip: int
    rest_frame: int
    bodies: Mapping[str, str]


def import_bvh(path: str | Path, character: str, *, fps: float | None = None, **skeletal: Unpack[Skeletal]) -> Import:
    """Import a ``.bvh`` file, with frames per second ``fps`` in place of its own and the options of a skeleton."""
    return fit_skeleton(read_bvh(path, fps=fps), character, **skeletal)


def import_amc(
    path: str | Path,
    character: str,
    *,
    asf: str | Path | None = None,
    fps: float | None = None,
    **skeletal: Unpack[Skeletal],
) -> Import:
    """Import an ``.amc`` file.

    Args:
        path: The file.
        character: Name of the character.
        asf: The file's skeleton; None for the one beside it.
        fps: Frames per second of the file; None for 120.
        **skeletal: Options of a skeleton.
    """
    return fit_skeleton(read_asf_amc(path, asf=asf, fps=fps), character, **skeletal)


def import_smpl(
    path: str | Path,
    character: str,
    *,
    body_model: str | Path | None = None,
    fps: float | None = None,
    **skeletal: Unpack[Skeletal],
) -> Import:
    """Import an ``.npz`` of SMPL's bodies, as of AMASS.

    Args:
        path: The file.
        character: Name of the character.
        body_model: Body model (``.npz``); None for the mean body.
        fps: Frames per second of the file; None for its own.
        **skeletal: Options of a skeleton.
    """
    return fit_skeleton(read_smpl(path, body_model=body_model, fps=fps), character, **skeletal)


def import_deepmimic(
    path: str | Path,
    character: str,
    *,
    rate: float | None = None,
    fps: float | None = None,
    quaternion: str = "wxyz",
    bodies: Mapping[str, str] | None = None,
) -> Import:
    """Import a ``.json`` or ``.txt`` file of DeepMimic's characters, in metres.

    Args:
        path: The file.
        character: Name of the character.
        rate: Frames per second of the clip; None for 30.
        fps: Frames per second of the file; None for its own.
        quaternion: Order of the components of quaternions, ``"wxyz"`` or ``"xyzw"``.
        bodies: Bodies of the character by part of a person, for inverse kinematics.
    """
    _require_order(quaternion)
    require_map_applies(bodies, character)
    human = character if character in HUMANS else "humanoid"
    fitted = fit_joints(path, human, read_deepmimic(path, fps=fps, quaternion=quaternion), rate, "deepmimic")
    return fitted if character == human else fit_clip(path, fitted.clip, character, rate, "deepmimic", bodies)


def import_clip(
    path: str | Path,
    character: str,
    *,
    rate: float | None = None,
    joint_map: Mapping[str, str] | None = None,
    skip: int = 0,
    bodies: Mapping[str, str] | None = None,
) -> Import:
    """Import a clip of this library, ``.npz``, which stays a cycle if it is one.

    Args:
        path: The file.
        character: Name of the character.
        rate: Frames per second of the clip; None for 30, or for the file's own if it is of the same character.
        joint_map: Bodies of the clip's character by part of a person.
        skip: Frames to leave out at the beginning.
        bodies: Bodies of the character by part of a person, for inverse kinematics.
    """
    require_map_applies(bodies, character)
    return fit_clip(path, MotionClip.load(path), character, rate, "clip", bodies, joint_map=joint_map, skip=skip)


def import_states(
    path: str | Path,
    character: str,
    *,
    rate: float | None = None,
    fps: float | None = None,
    quaternion: str | None = None,
    joints: Sequence[str] | None = None,
) -> Import:
    """Import ``qpos`` of the character itself, ``.csv`` or ``.npz``.

    Args:
        path: The file.
        character: Name of the character.
        rate: Frames per second of the clip; None for 30.
        fps: Frames per second of the file; None for its own.
        quaternion: Order of the components of quaternions; None for the order in which the root is upright.
        joints: Joints in the order of the columns; None for the names in the file, or else the order of the model.
    """
    if quaternion is not None:
        _require_order(quaternion)
    motion = read_qpos(path, character, fps=fps, quaternion=quaternion, joints=joints)
    return fit_joints(path, character, motion, rate, "qpos")


FORMATS: dict[str, tuple[Callable[..., Import], str]] = {
    "bvh": (import_bvh, "a skeleton's motion"),
    "amc": (import_amc, "a skeleton's motion"),
    "smpl": (import_smpl, "a skeleton's motion"),
    "deepmimic": (import_deepmimic, "a file of DeepMimic's"),
    "clip": (import_clip, "a clip"),
    "qpos": (import_states, "states of a character"),
}
"""Functions that import, by format, and what errors call such a file."""


def _format(path: str | Path) -> str:
    """Return the format of a file, one of :data:`FORMATS`, by its suffix and the names of its arrays."""
    match Path(path).suffix.lower():
        case ".bvh" | ".amc":
            return Path(path).suffix.lower().removeprefix(".")
        case ".json" | ".txt":
            return "deepmimic"
        case ".csv":
            return "qpos"
        case ".npz":
            archive = Archive(path)
            return "clip" if "character" in archive.names else "smpl" if is_smpl(archive) else "qpos"
        case ".pkl" | ".pickle":
            raise MotionFormatError(path, f"is a pickle file, and reading it can run any code: {UNPICKLE}")
    raise MotionFormatError(
        path, "must end in .bvh, .amc, .npz, .csv, .json or .txt: convert it to one of these formats"
    )


def _require_order(quaternion: str) -> None:
    """Check the order of the components of quaternions."""
    if quaternion not in QUATERNIONS:
        raise ValueError(
            f"quaternion={quaternion!r} must be an order of components: pass one of {', '.join(QUATERNIONS)}"
        )
