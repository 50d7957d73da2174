"""Acclaim's skeleton files (``.asf``)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.capture.skeleton import AXES, identities
from torchrl_mcp.envs.motions.capture.textfile import Statement, TextFile, shortened
from torchrl_mcp.envs.rotations import from_rotation_vector, multiply

INCH = 0.0254

TRANSLATIONS = ("tx", "ty", "tz")
ROTATIONS = ("rx", "ry", "rz")


@dataclass(frozen=True)
class Bone:
    """A bone, or the root, which has no length.

    Attributes:
        tip: End of the bone relative to its beginning, shape ``(3,)``.
        axes: Rotation C of the axes about which the bone turns, shape ``(4,)``.
        dof: Names of the channels.
    """

    tip: Tensor
    axes: Tensor
    dof: Sequence[str]


@dataclass(frozen=True)
class AsfSkeleton:
    """A skeleton in its rest pose.

    Attributes:
        path: The file.
        bones: Bones by name; each comes after its parent, the root first.
        parents: Name of the parent of each bone except the root.
        position: Default position of the root, shape ``(3,)``.
        unit: Metres per unit of length.
        degrees: Whether angles are in degrees, not radians.
    """

    path: Path
    bones: Mapping[str, Bone]
    parents: Mapping[str, str]
    position: Tensor
    unit: float
    degrees: bool


def read_asf(path: str | Path) -> AsfSkeleton:
    """Read a skeleton.

    Args:
        path: The file.

    Raises:
        MotionFormatError: If the file is not ASF, or is damaged.
    """
    file = TextFile.read(path)
    sections: dict[str, list[Statement]] = {}
    section: list[Statement] = []
    for statement in file.statements(comment="#"):
        keyword = statement.words[0].lower()
        if keyword.startswith(":"):
            section = sections.setdefault(keyword, [])
        else:
            section.append(statement)
    if missing := {":root", ":bonedata", ":hierarchy"} - sections.keys():
        raise file.error(f"has no section {', '.join(sorted(missing))}: pass an ASF file")
    unit, degrees = _units(file, sections.get(":units", []))
    position, root = _root(file, sections[":root"], degrees)
    bones = _bones(file, sections[":bonedata"], degrees)
    parents = _hierarchy(file, sections[":hierarchy"], bones)
    file.require_size(1, len(bones))
    ordered = {"root": root, **{name: bones[name] for name in parents}}
    return AsfSkeleton(file.path, ordered, parents, position, unit, degrees)


def _units(file: TextFile, section: Sequence[Statement]) -> tuple[float, bool]:
    """Read metres per unit of length, and whether angles are in degrees."""
    unit = INCH
    degrees = True
    for statement in section:
        match [word.lower() for word in statement.words]:
            case ["length", *_]:
                units_per_inch = file.number(statement)
                if units_per_inch < 1e-6:
                    raise file.error(
                        f"the length {units_per_inch:g} of an inch is too small: correct it", statement.line
                    )
                unit = INCH / units_per_inch
            case ["angle", ("deg" | "rad") as name]:
                degrees = name == "deg"
            case ["angle", *_]:
                raise file.error("the unit of angles must be deg or rad: correct it", statement.line)
    return unit, degrees


def _root(file: TextFile, section: Sequence[Statement], degrees: bool) -> tuple[Tensor, Bone]:
    """Read the position, axes and channels of the root."""
    position = [0.0] * 3
    angles = [0.0] * 3
    order = "xyz"
    dof: list[str] = []
    for statement in section:
        match statement.words[0].lower():
            case "position":
                position = file.vector(statement)
            case "orientation":
                angles = file.vector(statement)
            case "axis":
                order = _order(file, statement, statement.words[1:])
            case "order":
                dof = _dof(file, statement, (*TRANSLATIONS, *ROTATIONS))
    tip = torch.zeros(3, dtype=torch.float64)
    return torch.tensor(position, dtype=torch.float64), Bone(tip, _axes(angles, order, degrees), dof)


def _bones(file: TextFile, section: Sequence[Statement], degrees: bool) -> dict[str, Bone]:
    """Read the bones between ``begin`` and ``end``, by name."""
    bones: dict[str, Bone] = {}
    block: dict[str, Statement] = {}
    for statement in section:
        match statement.words[0].lower():
            case "begin":
                block = {"begin": statement}
            case "end":
                name, bone = _bone(file, block, statement.line, degrees)
                if name in bones or name == "root":
                    raise file.error(f"a second bone {shortened(name)}: rename it", statement.line)
                bones[name] = bone
                block = {}
            case keyword:
                block[keyword] = statement
    if block:
        raise file.error("the last bone has no 'end': the file is cut short", section[-1].line)
    return bones


def _bone(file: TextFile, block: Mapping[str, Statement], line: int, degrees: bool) -> tuple[str, Bone]:
    """Read one bone and its name; limits, masses and other entries are ignored."""
    if missing := {"name", "direction", "length"} - block.keys():
        raise file.error(f"a bone has no {', '.join(sorted(missing))}: add it", line)
    if len(block["name"].words) != 2:
        raise file.error("the name of a bone must be one word: correct it", block["name"].line)
    direction = torch.tensor(file.vector(block["direction"]), dtype=torch.float64)
    norm = float(torch.linalg.vector_norm(direction))
    if not 0.5 < norm < 2.0:
        raise file.error(f"the direction has length {norm:g}: give a unit vector", block["direction"].line)
    angles = [0.0] * 3
    order = "xyz"
    if "axis" in block:
        statement = block["axis"]
        angles = file.vector(Statement(statement.line, statement.words[:4]))
        order = _order(file, statement, statement.words[4:])
    dof = _dof(file, block["dof"], ROTATIONS) if "dof" in block else []
    return block["name"].words[1], Bone(
        direction / norm * file.number(block["length"]), _axes(angles, order, degrees), dof
    )


def _order(file: TextFile, statement: Statement, words: Sequence[str]) -> str:
    """Read an order of axes."""
    order = "".join(words).lower()
    if sorted(order) != ["x", "y", "z"]:
        raise file.error("the order of the axes must be one of XYZ, ..., ZYX: correct it", statement.line)
    return order


def _dof(file: TextFile, statement: Statement, known: Sequence[str]) -> list[str]:
    """Read the names of channels."""
    dof = [word.lower() for word in statement.words[1:]]
    if not set(dof) <= set(known) or len(set(dof)) < len(dof):
        raise file.error(f"channels other than {' '.join(known)}, each at most once, are not supported", statement.line)
    return dof


def _axes(angles: Sequence[float], order: str, degrees: bool) -> Tensor:
    """Rotation by three angles about fixed axes in the given order, shape ``(4,)``."""
    axes = identities()
    for which in map("xyz".index, order):
        angle = math.radians(angles[which]) if degrees else angles[which]
        axes = multiply(from_rotation_vector(angle * AXES[which]), axes)
    return axes


def _hierarchy(file: TextFile, section: Sequence[Statement], bones: Mapping[str, Bone]) -> dict[str, str]:
    """Read the parent of each bone, each after its parent."""
    parents: dict[str, str] = {}
    for line, words in section:
        if [word.lower() for word in words] in (["begin"], ["end"]):
            continue
        parent, *children = words
        if parent != "root" and parent not in parents:
            raise file.error(f"{shortened(parent)} is not attached to a bone yet: put its line first", line)
        for child in children:
            if child not in bones or child in parents:
                raise file.error(f"{shortened(child)} is not a bone, or is attached to two bones: correct it", line)
            parents[child] = parent
    if loose := sorted(bones.keys() - parents.keys()):
        raise file.error(f"{shortened(loose[0])} is not attached to a bone: add it to :hierarchy")
    return parents
