"""A walker's build, and the motion of its pelvis, trunk, head and arms over the stride."""

from dataclasses import dataclass
from functools import cache

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.gait.course import SIDES, Course
from torchrl_mcp.envs.motions.gait.curves import wave
from torchrl_mcp.envs.motions.gait.feet import Sole
from torchrl_mcp.envs.motions.gait.legs import Leg
from torchrl_mcp.envs.rotations import about_x, about_y, about_z, inverse, multiply, rotate

PELVIS_LEAN = 0.1
TRUNK_LEAN = 0.53
"""Lean into a turn, relative to :attr:`Course.lean`; the trunk's is measured."""

SHOULDER_LEAD = 0.035
HEAD_LEAD = 0.1
"""Lead into a turn of more than 1 rad/s, in radians."""


@dataclass(frozen=True, eq=False)
class Build:
    """Dimensions of a body that the generator uses.

    Args:
        trunk: Joint between pelvis and trunk.
        height: Height of the centre of mass at rest, in metres.
        leg: Bones of a leg.
        sole: Sole of a foot.
        pelvis_lever: Shift of the centre of mass when the pelvis tilts, in metres per radian.
        trunk_lever: Shift of the centre of mass when the trunk tilts, in metres per radian.
    """

    trunk: str
    height: float
    leg: Leg
    sole: Sole
    pelvis_lever: float
    trunk_lever: float

    def overhang(self, pelvis: Tensor, trunk: Tensor) -> Tensor:
        """Horizontal distance from the root to the centre of mass, without the legs, shape ``(F, 2)``.

        Args:
            pelvis: Orientation of the pelvis, shape ``(F, 4)``.
            trunk: Orientation of the trunk, shape ``(F, 4)``.
        """
        up = torch.tensor([0.0, 0.0, 1.0], dtype=pelvis.dtype)
        return (self.pelvis_lever * rotate(pelvis, up) + self.trunk_lever * rotate(trunk, up))[:, :2]


@cache
def build_of(character: str) -> Build:
    """Measure a character's model in its rest pose."""
    model = character_model(character)
    rest = mujoco.MjData(model)
    mujoco.mj_forward(model, rest)
    trunk = "chest" if character == "humanoid" else "torso"
    pelvis = model.body("root")
    upper = model.body(trunk)
    total = float(model.body_subtreemass[pelvis.id])
    upper_mass = float(model.body_subtreemass[upper.id])
    foot = model.geom("left_ankle")
    return Build(
        trunk=trunk,
        height=float(rest.subtree_com[pelvis.id, 2]),
        leg=Leg(
            thigh=-float(model.body("left_knee").pos[2]),
            shank=-float(model.body("left_ankle").pos[2]),
            hip=torch.from_numpy(model.body("left_hip").pos.copy()),
        ),
        sole=Sole(
            heel=float(foot.pos[0] - foot.size[0]),
            toe=float(foot.pos[0] + foot.size[0]),
            depth=float(foot.size[2] - foot.pos[2]),
        ),
        pelvis_lever=float(pelvis.mass[0] * pelvis.ipos[2] + upper_mass * upper.pos[2]) / total,
        trunk_lever=upper_mass * float(rest.subtree_com[upper.id, 2] - rest.xpos[upper.id, 2]) / total,
    )


def pelvis_orientation(course: Course, activity: Tensor) -> Tensor:
    """Orientation of the pelvis, which turns forward with the stepping leg and drops on the side of the swinging leg.

    Args:
        course: Course of the walk.
        activity: From 0, standing, to 1, walking, shape ``(F,)``.

    Returns:
        Quaternions, shape ``(F, 4)``.
    """
    yaw = activity * (2 + 1.8 * course.speed) * wave(course.phase, 0.06)
    drop = activity * 3.6 * (wave(course.phase, 0.225) + 0.15 * wave(course.phase, 0.2, 3))
    pitch = 3 + activity * (1.5 + 1.2 * wave(course.phase, 0.05, 2))
    return _turned(course, yaw, drop, pitch, PELVIS_LEAN)


def trunk_orientation(course: Course, activity: Tensor) -> Tensor:
    """Orientation of the trunk, which swings against the pelvis and leans over the loaded leg.

    Args:
        course: Course of the walk.
        activity: From 0, standing, to 1, walking, shape ``(F,)``.

    Returns:
        Quaternions, shape ``(F, 4)``.
    """
    yaw = activity * -3.2 * wave(course.phase, 0.05) + torch.rad2deg(SHOULDER_LEAD * course.turn_rate.tanh())
    roll = activity * 2.0 * wave(course.phase, 0.0)
    pitch = 4 + activity * (2 + 0.8 * wave(course.phase, 0.1, 2))
    return _turned(course, yaw, -roll, pitch, TRUNK_LEAN)


def head_and_arms(course: Course, activity: Tensor, trunk: Tensor) -> dict[str, Tensor]:
    """Joints of the head, which stays level and looks into turns, and of the arms, which swing with the opposite leg.

    Args:
        course: Course of the walk.
        activity: From 0, standing, to 1, walking, shape ``(F,)``.
        trunk: Orientation of the trunk, shape ``(F, 4)``.

    Returns:
        Quaternions ``(F, 4)`` of neck and shoulders and angles ``(F, 1)`` of the elbows, by name of the joint.
    """
    ahead = multiply(
        about_z(course.heading + HEAD_LEAD * course.turn_rate.tanh()), about_y(torch.full_like(activity, 0.03))
    )
    joints = {"neck": multiply(inverse(trunk), ahead)}
    for side in SIDES:
        phase = course.phase - side.offset
        swing = 5 - activity * 9 * (1 + course.speed) * wave(phase, 0.03)
        flexion = 15 + 7 * course.speed - activity * (5 + 9 * course.speed) * wave(phase, 0.07)
        outward = about_x(torch.full_like(swing, 0.22 * side.sign))
        inward = about_z(torch.full_like(swing, -0.25 * side.sign))
        joints[f"{side.name}_shoulder"] = multiply(outward, multiply(about_y(-torch.deg2rad(swing)), inward))
        joints[f"{side.name}_elbow"] = torch.deg2rad(flexion).unsqueeze(-1)
    return joints


def _turned(course: Course, yaw: Tensor, left: Tensor, pitch: Tensor, lean: float) -> Tensor:
    """Orientation along the course with a yaw, a roll to the left and into the turn, and a pitch; angles in degrees."""
    tilt = multiply(about_x(-torch.deg2rad(left) - lean * course.lean), about_y(torch.deg2rad(pitch)))
    return multiply(about_z(course.heading + torch.deg2rad(yaw)), tilt)
