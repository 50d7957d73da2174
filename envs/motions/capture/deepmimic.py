"""Motion files of DeepMimic and DeepLoco: JSON with the joint rotations of a humanoid or of a biped."""

import json
import re
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor

from torchrl_mcp.envs.motions.capture.joint_motion import (
    LONGEST,
    NO_ROTATION,
    TOP_SPEED,
    JointMotion,
    closed_values,
    speeds,
)
from torchrl_mcp.envs.motions.capture.skeleton import frame_rate
from torchrl_mcp.envs.motions.capture.textfile import LARGEST_NUMBER, TextFile, shortened

RIGHT_LEG, LEFT_LEG = ({f"{side}_hip": 4, f"{side}_knee": 1, f"{side}_ankle": 4} for side in ("right", "left"))
RIGHT_ARM, LEFT_ARM = ({f"{side}_shoulder": 4, f"{side}_elbow": 1} for side in ("right", "left"))

HUMANOID = {"root": 4, "chest": 4, "neck": 4, **RIGHT_LEG, **RIGHT_ARM, **LEFT_LEG, **LEFT_ARM}
BIPED = {"root": 4, "chest": 4, **RIGHT_LEG, **LEFT_LEG}
"""Columns of each joint, after duration and root position: a quaternion or an angle. The biped's chest is its torso."""

LAYOUTS = {4 + sum(joints.values()): joints for joints in (HUMANOID, BIPED)}
"""Joints by length of a frame."""


def read_deepmimic(path: str | Path, *, fps: float | None = None, quaternion: str = "wxyz") -> JointMotion:
    """Read a motion of DeepMimic's humanoid (44 numbers a frame) or of DeepLoco's biped (30).

    Their axes, x forward, y up, z right, become x forward, y left, z up.

    A motion that wraps continues from the position of its end with the orientation of its beginning. Its last frame
    approximately repeats the first; the difference is spread evenly over the cycle.

    Args:
        path: The file.
        fps: Frames per second of the file, or None for the file's own durations.
        quaternion: Order of the components of quaternions, ``"wxyz"`` or ``"xyzw"``.

    Returns:
        The motion by the joints of the humanoid; the humanoid and the biped can use both.

    Raises:
        MotionFormatError: If the file has another format, or is damaged.
        ValueError: If an argument is out of range.

    Reference:
        Peng et al., DeepMimic: Example-Guided Deep Reinforcement Learning of Physics-Based Character Skills, 2018,
        https://github.com/xbpeng/DeepMimic
    """
    file = TextFile.read(path)
    frames, loop = _content(file)
    root, motion = _motion(file, frames, quaternion)
    times = _times(file, frames[:, 0] if fps is None else torch.full_like(frames[:, 0], 1 / frame_rate(fps, 1.0)))
    _require_no_jump(file, root, times)
    if loop:
        root[:, 2] = closed_values(root[:, 2])
        motion = {joint: closed_values(values) for joint, values in motion.items()}
    return JointMotion(root, motion, times, loop)


def _content(file: TextFile) -> tuple[Tensor, bool]:
    """Read the frames, shape ``(T, 44)`` or ``(T, 30)``, and whether they wrap."""
    try:
        content = json.loads(file.text)
    except json.JSONDecodeError as error:
        raise file.error(f"must be JSON: {error.msg}", error.lineno) from error
    except (RecursionError, ValueError) as error:  # nested too deeply, or a number with too many digits
        raise file.error(f"must be the JSON of a motion: {error}", 1) from error
    if not isinstance(content, dict) or not isinstance(content.get("Frames"), list) or len(content["Frames"]) < 2:
        raise file.error('has no list of two or more "Frames": pass a motion of DeepMimic or DeepLoco', 1)
    frames = content["Frames"]
    loop = content.get("Loop", "none")
    if not isinstance(loop, bool) and loop not in ("wrap", "none"):
        raise file.error(f'"Loop" is {shortened(str(loop))}: correct it to "wrap" or "none"', 1)
    width = len(frames[0]) if isinstance(frames[0], list) else 0
    if width not in LAYOUTS:
        known = " or ".join(map(str, LAYOUTS))
        raise file.error(f"the first frame has {width} numbers: frames of {known} are supported", _line(file, 0))
    for index, frame in enumerate(frames):
        if not isinstance(frame, list) or len(frame) != width:
            raise file.error(
                f"frame {index + 1} must have {width} numbers, as the first frame: correct it", _line(file, index)
            )
        if not all(type(number) in (int, float) and abs(number) <= LARGEST_NUMBER for number in frame):
            message = f"frame {index + 1} holds a value that is not a number, not finite or absurdly large: correct it"
            raise file.error(message, _line(file, index))
    return torch.tensor(frames, dtype=torch.float64), loop in (True, "wrap")


def _line(file: TextFile, frame: int) -> int:
    """Line at which a frame begins, for an error: frames are lists of numbers, without inner brackets."""
    brackets = re.finditer(r"\[", file.text[file.text.find('"Frames"') :])
    bracket = next(islice(brackets, frame + 1, None), None)
    return file.text.count("\n", 0, file.text.find('"Frames"') + (bracket.start() if bracket else 0)) + 1


def _times(file: TextFile, durations: Tensor) -> Tensor:
    """Seconds from the first frame to each, shape ``(T,)``; the duration of the last frame is ignored."""
    if not (durations[:-1] > 0).all():
        frame = int((durations[:-1] <= 0).nonzero()[0])
        raise file.error(f"frame {frame + 1} lasts {durations[frame]:g} s: correct its duration", _line(file, frame))
    times = torch.cat([torch.zeros(1, dtype=torch.float64), durations[:-1].cumsum(0)])
    if times[-1] > LONGEST:
        frame = int((times > LONGEST).nonzero()[0]) - 1
        message = (
            f"frame {frame + 1} ends after {times[frame + 1]:g} s, more than an hour: correct durations, or split it"
        )
        raise file.error(message, _line(file, frame))
    return times


def _motion(file: TextFile, frames: Tensor, quaternion: str) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the path of the root, shape ``(T, 3)``, and quaternions or angles by joint, in this library's axes."""
    layout = LAYOUTS[frames.shape[1]]
    _, path, *columns = frames.split([1, 3, *layout.values()], dim=-1)
    axes = [quaternion.index(component) for component in "wxzy"]
    motion = {}
    for joint, column in zip(layout, columns, strict=True):
        if layout[joint] == 1:
            motion[joint] = column.squeeze(-1)
            continue
        length = torch.linalg.vector_norm(column, dim=-1, keepdim=True)
        if (length < NO_ROTATION).any():
            frame = int((length < NO_ROTATION).nonzero()[0, 0])
            message = f"the quaternion of the {joint} in frame {frame + 1} has length {length[frame, 0]:g}: correct it"
            raise file.error(message, _line(file, frame))
        motion[joint] = column[:, axes] / length * column.new_tensor([1.0, 1.0, -1.0, 1.0])
    return path[:, [0, 2, 1]] * path.new_tensor([1.0, -1.0, 1.0]), motion


def _require_no_jump(file: TextFile, root: Tensor, times: Tensor) -> None:
    fast = speeds(root, times) > TOP_SPEED
    if fast.any():
        frame = int(fast.nonzero()[0]) + 1
        message = f"the root jumps between frames {frame} and {frame + 1}, faster than {TOP_SPEED:g} m/s: cut it there"
        raise file.error(message, _line(file, frame))
