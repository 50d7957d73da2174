"""Retargeting the motion of any human skeleton to a character."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.anatomy import ARM, HEAD_AND_ARMS, LEG, LEGS, SIDES, TRUNK, limb
from torchrl_mcp.envs.motions.capture.feet import flat, from_straight, slope
from torchrl_mcp.envs.motions.capture.joint_motion import JointMotion, require_human
from torchrl_mcp.envs.motions.capture.recording import Recording, record
from torchrl_mcp.envs.motions.capture.skeleton import AXES, SourceMotion
from torchrl_mcp.envs.rotations import about_z, from_rotation_vector, inverse, multiply, rotate, shortest

BENT = math.radians(15)
"""Least flexion in radians at which a knee or an elbow determines its plane."""

UP = AXES[2]


def retarget(
    source: SourceMotion,
    character: str,
    *,
    scale: float | None = None,
    up: str | None = None,
    joint_map: Mapping[str, str] | None = None,
    skip: int = 0,
    rest_frame: int | None = None,
) -> tuple[JointMotion, Recording]:
    """Retarget a recorded motion to the humanoid or the biped.

    Parts of the character turn like the parts of the recorded body, relative to a standing pose with legs and arms
    straight down. A bone with another direction in the source's rest pose, such as the arms in a T-pose, is first
    brought there by the shortest rotation. Knees and elbows are hinges: they flex by the angle between the bones, and
    thigh and upper arm are twisted so that the hinge is normal to the plane of the limb. The root follows the middle of
    the hips; its path is scaled by the length of the legs. A constant rotation makes each foot flat.

    Args:
        source: The motion.
        character: ``"humanoid"``, or ``"biped"``, which has neither head nor arms.
        scale: Metres per unit of the source, or None for the file's unit or else one that fits the legs' length.
        up: Axis of the source that points up, such as ``"z"``; None to find it, see
            :func:`~torchrl_mcp.envs.motions.capture.upright.upright`.
        joint_map: See :func:`~torchrl_mcp.envs.motions.capture.anatomy.find_joints`.
        skip: Frames to leave out at the beginning.
        rest_frame: Frame, from 0 and before any are left out, in which the source stands upright, for sources whose
            rest pose does not stand upright.

    Returns:
        The motion of the character's joints, and the recording in the character's axes.

    Raises:
        MotionFormatError: If the build, size or speed is impossible for a human body.
        ValueError: If an argument is out of range.
    """
    require_human(character)
    has_arms = character == "humanoid"
    parts = (*TRUNK, *LEGS, *(HEAD_AND_ARMS if has_arms else ()))
    body = record(source, parts, scale=scale, up=up, joint_map=joint_map, skip=skip, rest_frame=rest_frame)
    root = body.turns["root"]
    chest = body.turns["chest"]
    motion = {"root": root, "chest": _relative(root, chest)}
    for side in SIDES:
        hip, knee, ankle = limb(side, LEG)
        thigh, motion[knee] = _hinged(body, limb(side, LEG), forward=-1.0)
        shank = multiply(thigh, _flexed(motion[knee]))
        foot = flat(body, ankle)
        motion[hip] = _relative(root, thigh)
        motion[ankle] = _relative(shank, foot)
        if has_arms:
            shoulder, elbow, _ = limb(side, ARM)
            upper_arm, motion[elbow] = _hinged(body, limb(side, ARM), forward=1.0)
            motion[shoulder] = _relative(chest, upper_arm)
    if has_arms:
        motion["neck"] = _relative(chest, body.turns["neck"])
    hips = (body.positions["right_hip"] + body.positions["left_hip"]) / 2
    hips[:, 2] -= hips[:, :2] @ slope(body)
    path = hips * (leg_length(character) / body.leg_length())
    return JointMotion(path, motion, body.times), body


def leg_length(character: str) -> float:
    """Metres from hip to ankle of a character's straight leg."""
    model = character_model(character)
    return -float(model.body("right_knee").pos[2] + model.body("right_ankle").pos[2])


def _relative(parent: Tensor, child: Tensor) -> Tensor:
    """Rotation of a part in the frame of its parent, shape ``(T, 4)``."""
    return multiply(inverse(parent), child)


def _flexed(angle: Tensor) -> Tensor:
    """Rotation of a hinge, about -y, shape ``(T, 4)``."""
    return from_rotation_vector(angle.unsqueeze(-1) * -AXES[1])


def _hinged(body: Recording, joints: tuple[str, str, str], *, forward: float) -> tuple[Tensor, Tensor]:
    r"""Fit a limb whose middle joint is a hinge about -y.

    :math:`l` is the direction of the lower bone in the frame of the upper one, whose own direction is -z. The upper
    bone is twisted by the azimuth :math:`\varphi` of :math:`l`, so that :math:`l` has no sideways component. Then

    .. math:: \theta = \operatorname{atan2}(l_x \cos \varphi + l_y \sin \varphi, -l_z)

    A nearly straight limb has no plane: its twist is interpolated between the frames before and after.

    Args:
        body: The recorded motion.
        joints: Joints of the limb, from the trunk outwards.
        forward: 1 for a limb that flexes forward, -1 for one that flexes backward.

    Returns:
        Rotation of the upper bone, shape ``(T, 4)``, and angle of the hinge, shape ``(T,)``.
    """
    start, middle, end = joints
    upper = from_straight(body, start, middle)
    bone = body.direction(start, middle)
    upper = multiply(shortest(rotate(upper, -UP.expand_as(bone)), bone), upper)  # for bones that position channels move
    x, y, z = rotate(inverse(upper), body.direction(middle, end)).unbind(-1)
    twist = _interpolated(torch.atan2(forward * y, forward * x), torch.atan2(torch.hypot(x, y), -z) > BENT)
    return multiply(upper, about_z(twist)), torch.atan2(x * twist.cos() + y * twist.sin(), -z)


def _interpolated(angles: Tensor, known: Tensor) -> Tensor:
    """Continuous angles over time, shape ``(T,)``, interpolated where unknown; 0 if all are unknown."""
    if not known.any():
        return torch.zeros_like(angles)
    frames = known.nonzero().squeeze(-1).numpy()
    return torch.from_numpy(np.interp(np.arange(len(angles)), frames, np.unwrap(angles[known].numpy())))
