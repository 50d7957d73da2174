"""Building a clip from the motion of a human body's joints."""

from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.contacts import contact_points
from torchrl_mcp.envs.rotations import from_rotation_vector, to_rotation_vector

HUMANS = ("humanoid", "biped")
"""Characters with the joints of a human body."""

TOP_SPEED = 25.0
"""Speed in m/s that parts of a body exceed only if the recording jumps from one pose to another."""

LONGEST = 3600.0
"""Longest duration in seconds; longer files are damaged, or would fill the memory."""

HIGHEST_RATE = 1000.0


def require_human(character: str) -> None:
    """Check that a character has the joints of a human body.

    Raises:
        ValueError: If it lacks them.
    """
    if character not in HUMANS:
        raise ValueError(f"character={character!r} has not the joints of a human body: pass one of {', '.join(HUMANS)}")


def assembled(
    character: str, path: Tensor, motion: Mapping[str, Tensor], times: Tensor, *, rate: float, loop: bool = False
) -> MotionClip:
    """Make a clip of the motion of a human body's joints.

    It begins at x = y = 0, with the soles on the ground, and respects the limits of the character's joints. Joints that
    the character lacks are left out; joints that only the character has stay straight.

    Args:
        character: ``"humanoid"`` or ``"biped"``.
        path: Position of the root, shape ``(T, 3)``, in metres.
        motion: Motion by joint of the humanoid: quaternions relative to the parent, shape ``(T, 4)``, or angles in
            radians, shape ``(T,)``; the root's quaternions are relative to the world.
        times: Times of the states in seconds, increasing from 0, shape ``(T,)``.
        rate: Frames per second of the clip; the nearest rate that divides its duration into whole frames is used.
        loop: Whether the motion repeats.

    Raises:
        ValueError: If fewer than two frames would remain at this rate.
    """
    duration = float(times[-1])
    steps = round(duration * rate) if 0 < rate <= HIGHEST_RATE else 0
    if steps < 1:
        raise ValueError(
            f"rate={rate} leaves less than two frames of {duration:g} s: pass a higher one, up to {HIGHEST_RATE:g}"
        )
    frames = np.interp(np.linspace(0, duration, steps + 1), times.numpy(), np.arange(len(times)))
    by_frame = MotionClip(character, grounded(character, states(character, path, motion)), fps=1.0)
    return MotionClip(character, by_frame.at(torch.from_numpy(frames)), steps / duration, loop)


def states(character: str, path: Tensor, motion: Mapping[str, Tensor]) -> Tensor:
    """States in MuJoCo's order, with joints within their limits, shape ``(T, nq)``; see :func:`assembled`."""
    model = character_model(character)
    qpos = torch.from_numpy(model.qpos0).repeat(len(path), 1)
    qpos[:, :3], qpos[:, 3:7] = path, motion["root"]
    for index in range(1, model.njnt):
        joint = model.joint(index)
        name = "chest" if joint.name == "torso" else joint.name
        if name in motion:
            place, (low, high) = joint.qposadr[0], joint.range
            if joint.type[0] == mujoco.mjtJoint.mjJNT_BALL:
                qpos[:, place : place + 4] = _within(motion[name], high)
            else:
                qpos[:, place] = motion[name].clamp(low, high)
    return qpos


def grounded(character: str, qpos: Tensor) -> Tensor:
    """Shift a motion to begin at x = y = 0, with feet below the ground in at most a fiftieth of the frames.

    Args:
        character: Name of the character.
        qpos: States, shape ``(T, nq)``.
    """
    shift = torch.cat([qpos[0, :2], torch.quantile(lowest_soles(character, qpos), 0.02).unsqueeze(0)])
    return torch.cat([qpos[:, :3] - shift, qpos[:, 3:]], dim=-1)


def lowest_soles(character: str, qpos: Tensor) -> Tensor:
    """Height of the lowest point of the feet, shape ``(T,)``, in metres."""
    bodies = body_states(character, qpos, torch.zeros(len(qpos), character_model(character).nv, dtype=torch.float64))
    points = [contact_points(character, foot, bodies).positions for foot in CHARACTERS[character].feet]
    return torch.cat(points, dim=1)[..., 2].amin(-1)


def speeds(path: Tensor, times: Tensor) -> Tensor:
    """Speed from each frame to the next, shape ``(T - 1,)``.

    Args:
        path: Positions, shape ``(T, 3)``.
        times: Times of the positions, shape ``(T,)``, in seconds.
    """
    return torch.linalg.vector_norm(path.diff(dim=0), dim=-1) / times.diff()


def _within(rotation: Tensor, limit: float) -> Tensor:
    """Clamp the angle of rotations, shape ``(T, 4)``."""
    vector = to_rotation_vector(rotation)
    angle = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    return torch.where(angle > limit, from_rotation_vector(vector * (limit / angle)), rotation)
