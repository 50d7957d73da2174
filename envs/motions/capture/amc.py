"""Acclaim's motion files (``.amc``), which move the bones of a skeleton file (``.asf``)."""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.capture.asf import TRANSLATIONS, AsfSkeleton, read_asf
from torchrl_mcp.envs.motions.capture.skeleton import AXES, SourceMotion, frame_rate, identities
from torchrl_mcp.envs.motions.capture.textfile import TextFile, shortened
from torchrl_mcp.envs.rotations import from_rotation_vector, inverse, multiply

CMU_FPS = 120.0
"""Frame rate of most of CMU's recordings, as the files have none; a few recordings have 60."""


def read_asf_amc(path: str | Path, *, asf: str | Path | None = None, fps: float | None = None) -> SourceMotion:
    r"""Read a motion and its skeleton.

    The channels of a bone turn it, one after the other, about fixed axes at its beginning:

    .. math:: R = C R_z R_y R_x C^{-1}

    A bone that a frame does not mention is not turned. Joints have the names of the bones that begin there; the ends of
    bones without children are joints as well.

    Args:
        path: The ``.amc`` file.
        asf: The ``.asf`` file, or None for the one beside it: ``02.asf`` for ``02_01.amc``, or else the only one.
        fps: Frames per second, which are not in the files; None is 120.

    Raises:
        MotionFormatError: If a file has another format or is damaged, or the two files do not match.

    Reference:
        M. Meredith and S. Maddock, Motion Capture File Formats Explained, 2001
    """
    file = TextFile.read(path)
    skeleton = read_asf(_beside(file) if asf is None else asf)
    names = list(skeleton.bones)
    leaves = [name for name in skeleton.bones if name not in skeleton.parents.values()]
    channels, lines = _motion(file, skeleton, len(names) + len(leaves))
    begins = [skeleton.position, *(skeleton.bones[parent].tip for parent in skeleton.parents.values())]
    offsets = torch.stack([*begins, *(skeleton.bones[name].tip for name in leaves)])
    translations = offsets.repeat(len(lines), 1, 1)
    rotations = identities(len(lines), len(offsets))
    columns = iter(channels.unbind(-1))
    for index, bone in enumerate(skeleton.bones.values()):
        turned = identities(len(lines))
        for key in bone.dof:
            value = next(columns)
            which = "xyz".index(key[1])
            if key in TRANSLATIONS:
                translations[:, index, which] = value
            else:
                turned = multiply(from_rotation_vector(value.unsqueeze(-1) * AXES[which]), turned)
        axes = bone.axes.expand(len(lines), 4)
        rotations[:, index] = multiply(multiply(axes, turned), inverse(axes))
    return SourceMotion(
        path=file.path,
        names=[*names, *(f"{name}_end" for name in leaves)],
        parents=[-1, *map(names.index, skeleton.parents.values()), *map(names.index, leaves)],
        translations=translations,
        rotations=rotations,
        fps=frame_rate(fps, CMU_FPS),
        unit=skeleton.unit,
        lines=lines,
    )


def _beside(file: TextFile) -> Path:
    """Find the skeleton of a motion file in its folder."""
    named = file.path.with_name(f"{file.path.stem.partition('_')[0]}.asf")
    candidates = [named] if named.is_file() else sorted(file.path.parent.glob("*.asf"))
    if len(candidates) != 1:
        raise file.error(f"its skeleton {named.name} must be beside it: put it there, or pass its path")
    return candidates[0]


def _motion(file: TextFile, skeleton: AsfSkeleton, joints: int) -> tuple[Tensor, Sequence[int]]:
    """Read the channels of all bones in their order, angles in radians, ``(T, C)``, and the lines of the frames."""
    values = array("d")
    lines = array("q")
    mentioned = {"root"}
    for line, frame in _frames(file, skeleton):
        mentioned = set(frame) if not lines else mentioned
        if "root" not in frame or set(frame) != mentioned:
            raise file.error("the frame lacks the root, or has other bones than the first: the file is cut short", line)
        lines.append(line)
        file.require_size(len(lines), joints)
        for name, bone in skeleton.bones.items():
            values.extend(frame.get(name) or [0.0] * len(bone.dof))
    if len(lines) < 2:
        raise file.error("holds fewer than two frames: pass an AMC file")
    channels = torch.tensor(values, dtype=torch.float64).view(len(lines), -1)
    if _in_degrees(file, skeleton):
        turns = torch.tensor([key not in TRANSLATIONS for bone in skeleton.bones.values() for key in bone.dof])
        channels = torch.where(turns, torch.deg2rad(channels), channels)
    return channels, lines


def _frames(file: TextFile, skeleton: AsfSkeleton) -> Iterator[tuple[int, Mapping[str, Sequence[float]]]]:
    """Read frame by frame: its line, and the channels of the bones that it mentions."""
    start = 0
    expected = 0.0
    frame: dict[str, Sequence[float]] = {}
    for line, (name, *words) in file.statements(comment="#"):
        if name.startswith(":"):
            continue
        if name.isdecimal() and not words:
            if start:
                yield start, frame
            [number] = file.numbers([name], line)
            if start and number != expected:
                raise file.error(f"this is frame {number:g}, but should be {expected:g}: correct it", line)
            start = line
            frame = {}
            expected = number + 1
        elif not start:
            raise file.error(f"{shortened(name)} is before the first frame: pass an AMC file", line)
        elif name not in skeleton.bones or name in frame:
            message = f"{shortened(name)} occurs twice, or is not a bone of {skeleton.path.name}: pass another skeleton"
            raise file.error(message, line)
        elif len(words) != len(skeleton.bones[name].dof):
            message = f"{name} has {len(words)} numbers, but {len(skeleton.bones[name].dof)} channels: correct it"
            raise file.error(message, line)
        else:
            frame[name] = file.numbers(words, line)
    if start:
        yield start, frame


def _in_degrees(file: TextFile, skeleton: AsfSkeleton) -> bool:
    """Whether angles are in degrees, according to the motion or else the skeleton."""
    units = {":degrees": True, ":radians": False}
    keywords = (statement.words[0].lower() for statement in file.statements(comment="#"))
    return next((units[keyword] for keyword in keywords if keyword in units), skeleton.degrees)
