"""States ``qpos`` of a character, as retargeted robot motions are shared (``.csv``, ``.npz``)."""

import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.joint_motion import (
    LONGEST,
    NO_ROTATION,
    QUATERNIONS,
    TOP_SPEED,
    JointMotion,
    speeds,
)
from torchrl_mcp.envs.motions.capture.skeleton import frame_rate
from torchrl_mcp.envs.motions.capture.textfile import TextFile, parsed
from torchrl_mcp.envs.rotations import inverse, rotate

ROOT = 7
"""Columns of the root: position and quaternion."""

RATES = ("fps", "frequency", "frame_rate", "framerate")
JOINTS = ("joint_names", "joints", "dof_names")
"""Names in archives of the frame rate and of the joints' names."""


def read_qpos(
    path: str | Path,
    character: str,
    *,
    fps: float | None = None,
    quaternion: str | None = None,
    joints: Sequence[str] | None = None,
) -> JointMotion:
    """Read states: root position in metres, root quaternion, and joints in radians.

    A CSV file has one frame a line; a first line with names makes any order of the joints' columns possible, and tells
    the order of the root's quaternion if its names end in x, y, z and w. An archive has ``qpos``, or ``root_pos``,
    ``root_rot`` and ``dof_pos``, and may have the frame rate and ``joint_names``. Columns that belong to no joint of
    the character are left out.

    Args:
        path: The file.
        character: Name of any registered character.
        fps: Frames per second, or None for the file's own; a CSV file has none.
        quaternion: Order of the components of quaternions, ``"wxyz"`` or ``"xyzw"``; None for the only one in which the
            root is upright. If it is in both, at headings near 0 or 180 degrees, ``qpos`` of archives is MuJoCo's
            ``wxyz``, and other files need to be told.
        joints: Names of the joints in the order of the columns; None for the names in the file, or else the order of
            the character's model.

    Raises:
        MotionFormatError: If the file does not fit the character, or is damaged.
        ValueError: If there is no such character.
    """
    model = character_model(character)
    source = TextFile.read(path) if Path(path).suffix.lower() == ".csv" else Archive(path)
    values, names, rate = _table(source) if isinstance(source, TextFile) else _arrays(source)
    if names and isinstance(source, TextFile):
        quaternion = _root_order(source, names[:ROOT], quaternion)
        names = names[ROOT:]
    rate = frame_rate(fps, rate)
    if rate is None:
        raise source.error("has no frame rate: pass it (--fps)")
    if len(values) < 2 or values.shape[1] < ROOT or len(values) / rate > LONGEST:
        raise source.error(
            f"has {len(values)} frames of {values.shape[1]} numbers at {rate:g} frames/s: pass two or more, up to an "
            f"hour, of a root position, a root quaternion and joints"
        )
    columns = _columns(source, model, joints or names, values.shape[1] - ROOT)
    position = values[:, :3]
    root = values[:, 3:ROOT]
    rest = values[:, ROOT:]
    order = [(quaternion or _order(source, model, root)).index(component) for component in "wxyz"]
    motion = {"root": _rotations(source, root[:, order], "root")}
    for name, found in columns.items():
        values = rest[:, found]
        motion[name] = _rotations(source, values[:, order], name) if len(found) == 4 else values[:, 0]
    times = torch.arange(len(position), dtype=torch.float64) / rate
    _require_no_jump(source, position, times)
    return JointMotion(position, motion, times)


def _table(file: TextFile) -> tuple[Tensor, list[str] | None, None]:
    """Read the numbers of a CSV file, and the names of all columns, if the first line has names."""
    rows = [(number, _words(line)) for number, line in enumerate(file.text.split("\n"), start=1) if line.strip()]
    named = bool(rows) and None in map(parsed, rows[0][1])
    names = [word.strip("\"'") for word in rows.pop(0)[1]] if named else None
    width = len(names or (rows[0][1] if rows else []))
    file.require_size(len(rows), width)
    values = []
    for number, words in rows:
        if len(words) != width:
            raise file.error(f"has {len(words)} numbers, but the first line has {width}: correct it", number)
        values.append(file.numbers(words, number))
    return torch.tensor(values, dtype=torch.float64).view(len(values), width), names, None


def _words(line: str) -> list[str]:
    """Split a line at semicolons, beside which commas are of decimals, or else at commas and blanks."""
    line = line.strip().rstrip(",;")
    return re.split(r"\s*;\s*", line.replace(",", ".")) if ";" in line else re.split(r"\s*,\s*|\s+", line)


def _root_order(file: TextFile, names: Sequence[str], quaternion: str | None) -> str | None:
    """Order of the root's quaternion by the names of its columns, if they end in x, y, z and w; or else the given."""
    ends = "".join(name[-1:].lower() for name in names)
    if ends[:3] == "xyz" and ends[3:] in ([quaternion] if quaternion else QUATERNIONS):
        return ends[3:]
    if set(ends) <= set("wxyz") or any(re.match(r"time|frame|index|t$", name.lower()) for name in names):
        raise file.error(
            f"its first {ROOT} columns are called {', '.join(names)}, but should be the root's position x, y, z and "
            f"its quaternion {quaternion or ' or '.join(QUATERNIONS)}: correct the names, or the order of the columns",
            1,
        )
    return quaternion


def _arrays(archive: Archive) -> tuple[Tensor, list[str] | None, float | None]:
    """Read the numbers of an archive, the names of its joints, if it has them, and its frame rate."""
    if "qpos" in archive.names:
        values = archive.numbers("qpos")
    elif {"root_pos", "root_rot", "dof_pos"} <= {*archive.names}:
        parts = [archive.numbers("root_pos", 3), archive.numbers("root_rot", 4), archive.numbers("dof_pos")]
        if len({len(part) for part in parts}) > 1 or parts[2].ndim != 2:
            raise archive.error("root_pos, root_rot and dof_pos should have the shapes (T, 3), (T, 4) and (T, N)")
        values = torch.cat(parts, dim=-1)
    else:
        raise archive.error(
            f"has the arrays {', '.join(archive.names)}: pass poses and trans of SMPL's bodies, qpos, or root_pos, "
            "root_rot and dof_pos"
        )
    if values.ndim != 2:
        raise archive.error(f"qpos has shape {tuple(values.shape)}, but should have (T, N)")
    names = [archive.array(key) for key in JOINTS if key in archive.names]
    return values, [str(name) for name in names[0].flatten()] if names else None, archive.number(*RATES)


def _columns(
    source: TextFile | Archive, model: mujoco.MjModel, names: Sequence[str] | None, width: int
) -> dict[str, list[int]]:
    """Columns after the root's of each joint of the character."""
    widths = {
        model.joint(index).name: 4 if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_BALL else 1
        for index in range(1, model.njnt)
    }
    owners = list(widths if names is None else names)
    if owners and owners[0] == model.joint(0).name and owners[0] not in widths:
        owners = owners[1:]
    if len(owners) != width:  # names of joints, not of columns
        owners = [name for name in owners for _ in range(widths.get(name, 1))]
    else:
        owners = [name if name in widths else re.sub(r"[._ ]?[wxyz]$", "", name) for name in owners]
    if len(owners) != width:
        raise source.error(
            f"has {width} numbers after the root's {ROOT}, but the joints need {len(owners)}: name the joints of its "
            f"columns (--joints); the character's are {', '.join(widths)}"
        )
    columns = {joint: [index for index, owner in enumerate(owners) if owner == joint] for joint in widths}
    if wrong := [joint for joint in widths if len(columns[joint]) != widths[joint]]:
        raise source.error(
            f"has {len(columns[wrong[0]])} columns of the joint {wrong[0]}, which needs {widths[wrong[0]]}: name the "
            f"joints of its columns (--joints); now they are {', '.join(dict.fromkeys(owners))}"
        )
    return columns


def _order(source: TextFile | Archive, model: mujoco.MjModel, root: Tensor) -> str:
    """Order of a quaternion's components with which the root is upright in most frames."""
    upright = rotate(inverse(torch.from_numpy(model.qpos0[3:ROOT])), root.new_tensor([0.0, 0.0, 1.0]))
    possible = []
    for order in QUATERNIONS:
        turns = _rotations(source, root[:, [order.index(component) for component in "wxyz"]], "root")
        if (rotate(turns, upright.expand(len(turns), 3))[:, 2] > 0.5).double().mean() > 0.5:
            possible.append(order)
    if "wxyz" in possible and isinstance(source, Archive) and "qpos" in source.names:
        return "wxyz"
    if len(possible) != 1:
        raise source.error(
            f"its root is upright in most frames with {'both orders' if possible else 'no order'} of the quaternion's "
            f"components: pass the right one (--quaternion {' or '.join(QUATERNIONS)})"
        )
    return possible[0]


def _require_no_jump(source: TextFile | Archive, position: Tensor, times: Tensor) -> None:
    if (fast := speeds(position, times) > TOP_SPEED).any():
        frame = int(fast.nonzero()[0]) + 1
        raise source.error(
            f"the root jumps between frames {frame} and {frame + 1}, faster than {TOP_SPEED:g} m/s: cut it there, "
            "correct the rate (--fps), or convert positions to metres"
        )


def _rotations(source: TextFile | Archive, quaternions: Tensor, joint: str) -> Tensor:
    """Normalise quaternions, shape ``(T, 4)``."""
    length = torch.linalg.vector_norm(quaternions, dim=-1, keepdim=True)
    if (length < NO_ROTATION).any():
        frame = int(length.argmin())
        raise source.error(
            f"the quaternion of the {joint} in frame {frame + 1} has length {length[frame, 0]:g}: correct it"
        )
    return quaternions / length
