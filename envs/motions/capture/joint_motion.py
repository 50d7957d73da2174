"""Building a clip from the motion of a human body's joints."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.ground import grounded
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.rotations import about_z, from_rotation_vector, heading, inverse, multiply, to_rotation_vector

HUMANS = ("humanoid", "biped")
"""Characters with the joints of a human body."""

TOP_SPEED = 25.0
"""Speed in m/s that parts of a body exceed only if the recording jumps from one pose to another."""

LONGEST = 3600.0
"""Longest duration in seconds; longer files are damaged, or would fill the memory."""

HIGHEST_RATE = 1000.0

NO_ROTATION = 0.1
"""Least length of a quaternion that is a rotation; such quaternions are normalised."""

QUATERNIONS = ("wxyz", "xyzw")
"""Orders of the components of quaternions in files."""


def require_human(character: str) -> None:
    """Check that a character has the joints of a human body.

    Raises:
        ValueError: If it lacks them.
    """
    if character not in HUMANS:
        raise ValueError(f"character={character!r} lacks the joints of a human body: pass one of {', '.join(HUMANS)}")


class JointMotion(NamedTuple):
    """Motion of a character's joints, not yet limited to what the character can do.

    Args:
        path: Position of the root, shape ``(T, 3)``, in metres.
        joints: Motion by joint: quaternions relative to the parent, shape ``(T, 4)``, or angles in radians, shape
            ``(T,)``; the root's quaternions are relative to the world. The biped's torso may be called ``chest``.
        times: Times of the states in seconds, increasing from 0, shape ``(T,)``.
        loop: Whether the motion repeats.
    """

    path: Tensor
    joints: Mapping[str, Tensor]
    times: Tensor
    loop: bool = False


def assembled(character: str, motion: JointMotion, *, rate: float) -> tuple[MotionClip, Tensor, str]:
    """Make a clip of a motion, and measure what the limits of the character's joints cut off.

    The clip begins at x = y = 0, with standing feet on the ground. Joints that the character lacks are left out; joints
    that only the character has stay straight.

    Args:
        character: Name of the character.
        motion: The motion.
        rate: Frames per second of the clip; the nearest rate that divides its duration into whole frames is used.

    Returns:
        The clip, the greatest angle in radians by which a joint of each frame was cut, shape ``(T,)``, and what was
        assumed about the ground, see :func:`~torchrl_mcp.envs.motions.capture.ground.grounded`.

    Raises:
        ValueError: If fewer than two frames would remain at this rate.
    """
    duration = float(motion.times[-1])
    require_frames(duration, rate)
    steps = round(duration * rate)
    frames = np.interp(np.linspace(0, duration, steps + 1), motion.times.numpy(), np.arange(len(motion.times)))
    qpos, cut = states(character, motion)
    qpos, ground = grounded(character, qpos, motion.times, loop=motion.loop)
    by_frame = MotionClip(character, qpos, fps=1.0)
    clip = MotionClip(character, by_frame.at(torch.from_numpy(frames)), steps / duration, motion.loop)
    return clip, cut, ground


def require_frames(duration: float, rate: float) -> None:
    """Check that a motion has two frames or more.

    Args:
        duration: Duration in seconds.
        rate: Frames per second.

    Raises:
        ValueError: If fewer than two frames would remain, or the rate is too high.
    """
    if not 0 < rate <= HIGHEST_RATE or round(duration * rate) < 1:
        raise ValueError(
            f"rate={rate} leaves less than two frames of {duration:g} s: pass a higher one, up to {HIGHEST_RATE:g}"
        )


def closed(motion: JointMotion) -> JointMotion:
    """Make a motion a cycle: heights, tilts of the root and joints end as they began; path and heading are kept."""
    path = motion.path.clone()
    root = motion.joints["root"]
    path[:, 2] = closed_values(path[:, 2])
    headings = about_z(heading(root))
    joints = {name: closed_values(values) for name, values in motion.joints.items() if name != "root"}
    joints["root"] = multiply(headings, closed_values(multiply(inverse(headings), root)))
    return motion._replace(path=path, joints=joints, loop=True)


def closed_values(values: Tensor) -> Tensor:
    """Close a cycle of numbers, ``(T,)``, or rotations, ``(T, 4)``, by spreading what is missing evenly over time."""
    fraction = torch.linspace(0, 1, len(values), dtype=torch.float64)
    if values.ndim == 1:
        return values + (values[0] - values[-1]) * fraction
    missing = to_rotation_vector(multiply(inverse(values[-1]), values[0]))
    return multiply(values, from_rotation_vector(fraction.unsqueeze(-1) * missing))


def states(character: str, motion: JointMotion) -> tuple[Tensor, Tensor]:
    """States in MuJoCo's order with joints within their limits, ``(T, nq)``, and the angles cut from each, ``(T,)``."""
    model = character_model(character)
    qpos = torch.from_numpy(model.qpos0).repeat(len(motion.path), 1)
    qpos[:, :3] = motion.path
    qpos[:, 3:7] = motion.joints["root"]
    cut = torch.zeros(len(qpos), dtype=torch.float64)
    for index in range(1, model.njnt):
        joint = model.joint(index)
        name = "chest" if joint.name == "torso" and "chest" in motion.joints else joint.name
        if name not in motion.joints:
            continue
        values = motion.joints[name]
        place = joint.qposadr[0]
        low, high = joint.range if model.jnt_limited[index] else (-math.inf, math.inf)
        if joint.type[0] == mujoco.mjtJoint.mjJNT_BALL:
            qpos[:, place : place + 4], excess = _within(values, high)
        else:
            qpos[:, place] = values.clamp(low, high)
            excess = (values - qpos[:, place]).abs()
        cut = torch.maximum(cut, excess)
    return qpos, cut


def speeds(path: Tensor, times: Tensor) -> Tensor:
    """Speed from each frame to the next, shape ``(T - 1,)``.

    Args:
        path: Positions, shape ``(T, 3)``.
        times: Times of the positions, shape ``(T,)``, in seconds.
    """
    return torch.linalg.vector_norm(path.diff(dim=0), dim=-1) / times.diff()


def _within(rotation: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Clamp the angle of rotations, shape ``(T, 4)``, and return what is cut, shape ``(T,)``."""
    vector = to_rotation_vector(rotation)
    angle = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    clamped = torch.where(angle > limit, from_rotation_vector(vector * (limit / angle)), rotation)
    return clamped, (angle - limit).clamp_min(0).squeeze(-1)
