"""BVH files: a skeleton, and for every frame the channels of all its joints in one row."""

import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.capture.skeleton import AXES, SourceMotion, frame_rate, identities
from torchrl_mcp.envs.motions.capture.textfile import Statement, TextFile, shortened
from torchrl_mcp.envs.rotations import from_rotation_vector, multiply

CHANNEL = re.compile(r"([xyz])(position|rotation)", re.IGNORECASE)

FRAME_TIMES = (1e-4, 1.0)
"""Range of seconds per frame, from the fastest cameras to the slowest."""


@dataclass
class _Joint:
    """A joint as declared; its channels are pairs of an axis, ``"x"``, ..., and ``"position"`` or ``"rotation"``."""

    name: str
    parent: int
    line: int
    offset: list[float] | None = None
    channels: list[tuple[str, str]] = field(default_factory=list)


def read_bvh(path: str | Path, *, fps: float | None = None) -> SourceMotion:
    r"""Read a BVH file.

    The rotations of a joint are applied in the order of its channels, each about an axis turned by the previous ones:

    .. math:: R = R_{c_1} R_{c_2} R_{c_3}

    A position channel of any joint replaces that component of its offset. End sites become joints.

    Args:
        path: The file.
        fps: Frames per second, or None for the file's own rate.

    Raises:
        MotionFormatError: If the file is not BVH, or is damaged.

    Reference:
        M. Meredith and S. Maddock, Motion Capture File Formats Explained, 2001
    """
    file = TextFile.read(path)
    statements = file.statements(separators="{}")
    joints = _hierarchy(file, takewhile(lambda statement: statement.words[0].upper() != "MOTION", statements))
    rate, values, lines = _motion(file, statements, joints, fps)
    translations, rotations = _transforms(joints, values)
    return SourceMotion(
        path=file.path,
        names=[joint.name for joint in joints],
        parents=[joint.parent for joint in joints],
        translations=translations,
        rotations=rotations,
        fps=rate,
        unit=None,
        lines=lines,
    )


def _hierarchy(file: TextFile, statements: Iterator[Statement]) -> list[_Joint]:
    """Read the joints, each after its parent."""
    first = next(statements, Statement(1, [""]))
    if first.words[0].upper() != "HIERARCHY":
        raise file.error("does not begin with HIERARCHY: pass a BVH file", first.line)
    joints: list[_Joint] = []
    opened: list[int] = []  # joints whose braces are open, outermost first
    for statement in statements:
        line, words = statement
        match words[0].upper():
            case "ROOT" | "JOINT" | "END":
                joints.append(_declared(file, statement, joints, opened))
                opened.append(len(joints) - 1)
                file.require_size(1, len(joints))
                if next(statements, statement).words != ["{"]:
                    raise file.error(f"no {{ follows the name {shortened(joints[-1].name)}: add it", line)
            case "}" if opened:
                opened.pop()
            case "OFFSET" if opened:
                joints[opened[-1]].offset = file.vector(statement)
            case "CHANNELS" if opened:
                joints[opened[-1]].channels = _declared_channels(file, statement)
            case _:
                raise file.error(f"{shortened(words[0])} does not belong here: check keywords and braces", line)
    if opened or not joints:
        message = "the skeleton ends before its braces are closed: the file is cut short, or a } is missing"
        raise file.error(message, joints[opened[-1]].line if opened else first.line)
    for joint in joints:
        if joint.offset is None:
            raise file.error(f"{shortened(joint.name)} has no OFFSET: add one", joint.line)
    return joints


def _declared(file: TextFile, statement: Statement, joints: Sequence[_Joint], opened: Sequence[int]) -> _Joint:
    """Read ``ROOT name``, ``JOINT name`` or ``End Site``."""
    keyword = statement.words[0].upper()
    name = " ".join(statement.words[1:])
    if not name:
        raise file.error(f"{keyword} without a name: add one", statement.line)
    if (keyword == "ROOT") == bool(joints):
        raise file.error("the first joint, and no other, is the ROOT: give each skeleton its own file", statement.line)
    if keyword == "ROOT":
        return _Joint(name, -1, statement.line)
    if not opened:
        raise file.error(f"{keyword} is outside of the root: check the braces", statement.line)
    parent = opened[-1]
    return _Joint(f"{joints[parent].name}_end" if keyword == "END" else name, parent, statement.line)


def _declared_channels(file: TextFile, statement: Statement) -> list[tuple[str, str]]:
    """Read ``CHANNELS 3 Zrotation Xrotation Yrotation``."""
    _, *words = statement.words
    matches = [CHANNEL.fullmatch(word) for word in words[1:]]
    channels = [(match[1].lower(), match[2].lower()) for match in matches if match]
    if not words or words[0] != str(len(channels)) or len(channels) != len(matches):
        message = "CHANNELS is not followed by a number and as many of Xposition, ..., Zrotation: correct it"
        raise file.error(message, statement.line)
    if len(set(channels)) != len(channels):
        raise file.error("CHANNELS names a channel twice: remove one", statement.line)
    return channels


def _motion(
    file: TextFile, statements: Iterator[Statement], joints: Sequence[_Joint], fps: float | None
) -> tuple[float, Tensor, Sequence[int]]:
    """Read the part after ``MOTION``: frames per second, channels, shape ``(T, C)``, and the lines of the frames."""
    frames = _header(file, statements, "Frames")
    time = _header(file, statements, "Frame Time")
    rate = frame_rate(fps, _stated_rate(file, time) if fps is None else 1.0)
    width = sum(len(joint.channels) for joint in joints)
    values = array("d")
    lines = array("q")
    for line, words in statements:
        if len(words) != width:
            raise file.error(f"has {len(words)} numbers, but the skeleton has {width} channels: correct it", line)
        values.extend(file.numbers(words, line))
        lines.append(line)
    declared = file.number(frames)
    if declared != len(lines) or len(lines) < 2:
        message = f"{declared:g} frames are declared, {len(lines)} follow: they should be equal, and >= 2"
        raise file.error(message, frames.line)
    file.require_size(len(lines), len(joints))
    return rate, torch.tensor(values, dtype=torch.float64).view(len(lines), width), lines


def _header(file: TextFile, statements: Iterator[Statement], key: str) -> Statement:
    """Read ``key: word``."""
    statement = next(statements, None)
    if statement is None:
        raise file.error(f"has no '{key}:': the file is cut short", file.text.count("\n") + 1)
    name, _, value = " ".join(statement.words).partition(":")
    if name.strip().lower() != key.lower() or len(value.split()) != 1:
        raise file.error(f"this line should be '{key}:' and a number: correct it", statement.line)
    return Statement(statement.line, [key, *value.split()])


def _stated_rate(file: TextFile, time: Statement) -> float:
    """Frames per second by the file's own ``Frame Time``."""
    seconds, (shortest, longest) = file.number(time), FRAME_TIMES
    if not shortest <= seconds <= longest:
        message = f"Frame Time is {seconds:g} s: correct it to {shortest:g} to {longest:g} s, or give the rate (--fps)"
        raise file.error(message, time.line)
    return 1 / seconds


def _transforms(joints: Sequence[_Joint], values: Tensor) -> tuple[Tensor, Tensor]:
    """Convert channels to translations and rotations, shapes ``(T, J, 3)`` and ``(T, J, 4)``."""
    offsets = torch.tensor([joint.offset for joint in joints], dtype=torch.float64)
    translations = offsets.repeat(len(values), 1, 1)
    rotations = identities(len(values), len(joints))
    columns = iter(values.unbind(-1))
    for index, joint in enumerate(joints):
        for axis, kind in joint.channels:
            value = next(columns)
            which = "xyz".index(axis)
            if kind == "position":
                translations[:, index, which] = value
            else:
                turn = from_rotation_vector(torch.deg2rad(value).unsqueeze(-1) * AXES[which])
                rotations[:, index] = multiply(rotations[:, index], turn)
    return translations, rotations
