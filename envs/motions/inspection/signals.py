"""Angles and positions of a walk over time, relative to its direction of progression."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import BodyStates, body_names
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.contacts import contact_points
from torchrl_mcp.envs.motions.keyframes import smoothed
from torchrl_mcp.envs.rotations import heading, rotate


class RootSignals(NamedTuple):
    """Signals of pelvis and trunk, each ``(T,)`` unless stated, in metres, m/s and degrees except the heading.

    Args:
        position: Horizontal position of the root, shape ``(T, 2)``.
        path: Smoothed position, shape ``(T, 2)``.
        heading: Smoothed heading in radians.
        speed: Speed along the heading.
        height: Height of the root.
        sway: Distance to the left of the path.
        pelvis_yaw: Yaw of the pelvis relative to the heading.
        pelvis_list: Roll of the pelvis, left side up.
        trunk_yaw: Yaw of the trunk relative to the heading.
        trunk_roll: Roll of the trunk to the left.
    """

    position: Tensor
    path: Tensor
    heading: Tensor
    speed: Tensor
    height: Tensor
    sway: Tensor
    pelvis_yaw: Tensor
    pelvis_list: Tensor
    trunk_yaw: Tensor
    trunk_roll: Tensor


class LegSignals(NamedTuple):
    """Signals of a leg and the arm on its side, each ``(T,)``, in metres, m/s and degrees.

    Args:
        ahead: Distance of the ankle ahead of the root, along the heading.
        toe_ahead: Distance of the toes ahead of the root, along the heading.
        across: Distance of the ankle to the left of the path.
        thigh: Angle of the thigh forward from the vertical.
        knee: Flexion of the knee.
        ankle: Dorsiflexion in the plane of progression.
        pitch: Pitch of the foot, toes up.
        toe_height: Height of the sole at the toes.
        ankle_speed: Horizontal speed of the ankle.
        arm: Angle of the upper arm forward from the vertical; NaN without arms.
        elbow: Flexion of the elbow; NaN without arms.
    """

    ahead: Tensor
    toe_ahead: Tensor
    across: Tensor
    thigh: Tensor
    knee: Tensor
    ankle: Tensor
    pitch: Tensor
    toe_height: Tensor
    ankle_speed: Tensor
    arm: Tensor
    elbow: Tensor


def root_signals(clip: MotionClip, states: BodyStates, window: float) -> RootSignals:
    """Return the signals of pelvis and trunk.

    Args:
        clip: Clip of T frames.
        states: States of its bodies.
        window: Length in seconds of the Hann window that smooths path and heading.
    """
    trunk = states.orientations[:, 1]  # the body above the pelvis
    pelvis = states.orientations[:, 0]
    yaw = unwrapped(heading(pelvis))
    facing = smoothed(yaw, clip.fps, window)
    position = states.positions[:, 0, :2]
    path = smoothed(position.T, clip.fps, window).T
    forward, left = _axes(facing)
    return RootSignals(
        position=position,
        path=path,
        heading=facing,
        speed=(states.linear_velocities[:, 0, :2] * forward).sum(-1),
        height=states.positions[:, 0, 2],
        sway=((position - path) * left).sum(-1),
        pelvis_yaw=torch.rad2deg(yaw - facing),
        pelvis_list=torch.rad2deg(_axis(pelvis, 1)[:, 2].asin()),
        trunk_yaw=torch.rad2deg(unwrapped(heading(trunk)) - facing),
        trunk_roll=_inclination(_axis(trunk, 2), left),
    )


def leg_signals(clip: MotionClip, states: BodyStates, side: str, root: RootSignals) -> LegSignals:
    """Return the signals of the leg and the arm of a side, ``"right"`` or ``"left"``."""
    names = body_names(clip.character)
    model = character_model(clip.character)
    forward, left = _axes(root.heading)
    foot = names.index(f"{side}_ankle")
    ankle = states.positions[:, foot, :2]
    points = contact_points(clip.character, names[foot], states)
    at_toes = points.offsets[:, 0] > points.offsets[:, 0].mean()
    toes = points.positions[:, at_toes & (points.offsets[:, 2] < points.offsets[:, 2].mean())].mean(1)
    thigh = _inclination(-_axis(states.orientations[:, names.index(f"{side}_hip")], 2), forward)
    knee = -torch.rad2deg(clip.qpos[:, model.joint(f"{side}_knee").qposadr[0]])
    sole = _axis(states.orientations[:, foot], 0)
    pitch = torch.rad2deg(torch.atan2(sole[:, 2], (sole[:, :2] * forward).sum(-1)))
    arm = elbow = torch.full_like(knee, torch.nan)
    if f"{side}_elbow" in names:
        arm = _inclination(-_axis(states.orientations[:, names.index(f"{side}_shoulder")], 2), forward)
        elbow = torch.rad2deg(clip.qpos[:, model.joint(f"{side}_elbow").qposadr[0]])
    return LegSignals(
        ahead=((ankle - root.position) * forward).sum(-1),
        toe_ahead=((toes[:, :2] - root.position) * forward).sum(-1),
        across=((ankle - root.path) * left).sum(-1),
        thigh=thigh,
        knee=knee,
        ankle=pitch - thigh + knee,
        pitch=pitch,
        toe_height=toes[:, 2],
        ankle_speed=torch.linalg.vector_norm(states.linear_velocities[:, foot, :2], dim=-1),
        arm=arm,
        elbow=elbow,
    )


def unwrapped(angles: Tensor) -> Tensor:
    """Remove jumps of full turns from angles over time, shape ``(T,)``."""
    steps = angles.diff()
    return angles + torch.cat(
        [torch.zeros_like(angles[:1]), -(steps / (2 * torch.pi)).round().cumsum(0) * 2 * torch.pi]
    )


def _axes(facing: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal unit vectors forward and to the left of headings ``(T,)``, each ``(T, 2)``."""
    cosine, sine = facing.cos(), facing.sin()
    return torch.stack([cosine, sine], dim=-1), torch.stack([-sine, cosine], dim=-1)


def _axis(orientations: Tensor, index: int) -> Tensor:
    """One of a body's axes in the world, shape ``(T, 3)``."""
    return rotate(orientations, torch.eye(3, dtype=orientations.dtype)[index])


def _inclination(axis: Tensor, towards: Tensor) -> Tensor:
    """Degrees, shape ``(T,)``, by which axes ``(T, 3)`` lean from the vertical towards directions ``(T, 2)``."""
    return torch.rad2deg(torch.atan2((axis[:, :2] * towards).sum(-1), axis[:, 2].abs()))
