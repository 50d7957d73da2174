"""A generator of human walking with any speed and turn rate over time, for characters with human legs."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.body import build_of, head_and_arms, pelvis_orientation, trunk_orientation
from torchrl_mcp.envs.motions.gait.course import GRAVITY, SIDES, Course, Side, plan, stride_rate
from torchrl_mcp.envs.motions.gait.curves import settled
from torchrl_mcp.envs.motions.gait.feet import Foot, step
from torchrl_mcp.envs.motions.gait.legs import leg_joints, pelvis_height
from torchrl_mcp.envs.rotations import inverse, multiply

WALKERS = ("humanoid", "biped")

FPS = 60.0
SLOWEST_FPS = 30.0
FASTEST = 1.6
SHARPEST = 3.2

MARGIN = 4.0
"""Seconds walked before and after the clip, so that the ends of the course do not affect it."""

AHEAD = 0.053
STRIDE = 0.82
"""Forward shift of the pelvis in long strides, and the scale of their length, in metres: pressure moves to the toes."""


def walk(character: str, speed: Tensor, turn_rate: Tensor, *, fps: float = FPS) -> MotionClip:
    r"""Walk with given speeds and turn rates.

    Feet stand on footholds beside the path, roll over heel and toe without sliding, and swing. The point :math:`p(t)`
    at which the feet carry the body determines the position of the body: the centre of mass is the only bounded motion
    of the inverted pendulum :math:`\ddot x = \omega^2 (x - p)`, so that forces within the soles can produce it,

    .. math:: x(t) = \frac{\omega}{2} \int e^{-\omega |t - s|} p(s) \, ds, \qquad \omega^2 = g / h

    Pelvis, trunk, head and arms swing about it as in people; the legs follow by inverse kinematics. If speed and turn
    rate are 0, the character stands. Both should change smoothly, over half a second or more.

    Args:
        character: ``"humanoid"`` or ``"biped"``.
        speed: Speed of every frame in m/s, shape ``(T,)``; meant for 0 to 1.5.
        turn_rate: Turn rate of every frame in rad/s, positive to the left, shape ``(T,)``; meant for up to 1.6 at the
            speeds of people in such turns, 1.15 m/s - 0.25 m per rad, and for up to 3 when almost on the spot.
        fps: Frames per second.

    Raises:
        ValueError: If the character cannot walk like this, or speeds or turn rates are out of range.

    Reference:
        Kajita et al., The 3D linear inverted pendulum mode, 2001, https://doi.org/10.1109/IROS.2001.973365

    Example:
        >>> import torch
        >>> clip = walk("biped", torch.full((121,), 1.0), torch.zeros(121))
        >>> clip.duration, round(float(clip.qpos[-1, 0] - clip.qpos[0, 0]), 1)
        (2.0, 2.0)
    """
    _check(character, speed, turn_rate, fps)
    before = round(MARGIN * fps)
    profile = torch.stack([speed, turn_rate]).double()
    speed, turn_rate = pad(profile.unsqueeze(0), (before, before), mode="replicate")[0]
    qpos = _states(character, speed, turn_rate, fps, start=before)
    return MotionClip(character, qpos[before:-before], fps)


def stride(character: str, speed: float, turn_rate: float, *, strides: int = 1) -> MotionClip:
    """Walk with constant speed and turn rate, as a clip that loops after whole strides.

    Args:
        character: ``"humanoid"`` or ``"biped"``.
        speed: Speed in m/s, more than 0.
        turn_rate: Turn rate in rad/s.
        strides: Number of strides.
    """
    rate = torch.tensor([speed, turn_rate], dtype=torch.float64)
    duration = strides / float(stride_rate(*rate))
    frames = round(duration * FPS)
    fps = frames / duration
    clip = walk(character, *rate.unsqueeze(-1).expand(2, frames + 1), fps=fps)
    return MotionClip(character, clip.qpos, fps, loop=True)


def _states(character: str, speed: Tensor, turn_rate: Tensor, fps: float, start: int) -> Tensor:
    """States of all frames, shape ``(F, nq)``."""
    model = character_model(character)
    build = build_of(character)
    course = plan(speed, turn_rate, fps, build.height, start)
    feet = {side: step(course, side, build.sole) for side in SIDES}
    activity = settled(torch.hypot(speed, 0.15 * turn_rate), 0.15)
    pelvis = pelvis_orientation(course, activity)
    trunk = trunk_orientation(course, activity)
    position = (
        _balanced(course, feet, build.height)
        - build.overhang(pelvis, trunk)
        + (AHEAD * settled(speed / stride_rate(speed, turn_rate), STRIDE)).unsqueeze(-1) * course.forward
    )
    height = pelvis_height(course, build.leg, pelvis, position, feet, activity)
    root = torch.cat([position, height.unsqueeze(-1)], dim=-1)
    joints = {"root": torch.cat([root, pelvis], dim=-1), build.trunk: multiply(inverse(pelvis), trunk)}
    for side in SIDES:
        hip, knee, ankle = leg_joints(build.leg, side, pelvis, root, feet[side], course.heading)
        joints |= {f"{side.name}_hip": hip, f"{side.name}_knee": -knee.unsqueeze(-1), f"{side.name}_ankle": ankle}
    if character == "humanoid":
        joints |= head_and_arms(course, activity, trunk)
    qpos = torch.empty(len(speed), model.nq, dtype=torch.float64)
    for name, values in joints.items():
        first = model.joint(name).qposadr[0]
        qpos[:, first : first + values.shape[-1]] = values
    return qpos


def _balanced(course: Course, feet: Mapping[Side, Foot], height: float) -> Tensor:
    """Position of the centre of mass, shape ``(F, 2)``, by the equation of :func:`walk` with p from the feet."""
    right, left = (feet[side] for side in SIDES)
    share = ((1 - right.unloaded) / (2 - right.unloaded - left.unloaded)).unsqueeze(-1)
    support = share * right.support + (1 - share) * left.support
    half = round(MARGIN * course.fps)
    time = torch.arange(-half, half + 1, dtype=torch.float64).abs() / course.fps
    kernel = torch.exp(-math.sqrt(GRAVITY / height) * time)
    padded = pad(support.T.unsqueeze(1), (half, half), mode="replicate")
    return conv1d(padded, (kernel / kernel.sum()).view(1, 1, -1)).squeeze(1).T


def _check(character: str, speed: Tensor, turn_rate: Tensor, fps: float) -> None:
    if character not in WALKERS:
        raise ValueError(f"character={character!r} cannot walk like this: pass one of {WALKERS}")
    if speed.ndim != 1 or speed.shape != turn_rate.shape or len(speed) < 2:
        shapes = f"{tuple(speed.shape)} and {tuple(turn_rate.shape)}"
        raise ValueError(f"speed and turn_rate have shapes {shapes}: pass (T,) both, T >= 2")
    for name, value, least, most in (("speed", speed, 0.0, FASTEST), ("turn_rate", turn_rate, -SHARPEST, SHARPEST)):
        if not ((least <= value) & (value <= most)).all():
            raise ValueError(f"{name} leaves the range of the generator: pass values from {least} to {most}")
    if not fps >= SLOWEST_FPS:
        raise ValueError(f"fps={fps} is too coarse for steps: pass at least {SLOWEST_FPS:g}, and resample the clip")
