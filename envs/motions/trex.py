"""Walks of the Tyrannosaurus: keyframes of a stride, splines between them, and inverse kinematics of the legs.

Phases of a stride go from 0 to 1; the right foot touches down at 0, the left foot half a stride later.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model, joint_layout
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.keyframes import Keyframes, halting, minimum_jerk, smooth
from torchrl_mcp.envs.motions.placement import Placement
from torchrl_mcp.envs.rotations import about_x, about_y, about_z, from_rotation_vector, inverse, multiply, rotate

FPS = 60.0
GRAVITY = 9.81

# Alexander (1976): animals of hip height h that walk at Fr = v^2 / (g h) make strides of 2.3 h Fr^0.3. For this body
# that is 1.10 m at 1 m/s, the speed of the transfer tasks. (Walking slowly at the natural frequency of an adult's tail,
# van Bijlert et al., 2021, scales to 0.7 m/s and strides of 1.7 s.)
STRIDE_TIME = 1.1
"""Seconds of a stride."""

STRIDES = 2
"""Strides in a clip of 2.2 s. Five clips last as long as the paper's 11 s."""

STRAIGHT = (1.0, 0.0)
LEFT_TURNS = ((0.9, 0.5), (0.8, 1.0))
"""Speeds in m/s and turn rates in rad/s; turns are slower."""

HEIGHT = 0.9
"""Height of the hips in metres: 3 cm lower than at rest, so that the legs reach from step to step."""

# Metres relative to path and height, and distances between and ahead of the feet, chosen so that ground forces on the
# feet can produce the motion: the weight shifts from foot to foot as the body sways, falls back and catches up.
SWAY: Keyframes = ((0.06, 0.0), (0.31, -0.018), (0.56, 0.0), (0.81, 0.018))
SURGE: Keyframes = ((0.185, 0.01), (0.435, -0.01), (0.685, 0.01), (0.935, -0.01))
BOB: Keyframes = ((0.055, -0.012), (0.305, 0.012), (0.555, -0.012), (0.805, 0.012))
STEP_WIDTH, STILL_WIDTH = 0.12, 0.3
"""Distance in metres between the feet in a walk, and in steps on the spot, where a foot does not pass the other."""

FULL_WALK = 0.8
"""Speed in m/s below which the body surges less, and steps are wider and flatter."""

TOE_AHEAD = 0.19
"""Distance in metres of a foot's tip ahead of the hips in the middle of its stance."""

# In radians. The right hip is ahead when the right foot touches down, and the pelvis drops on the swinging side.
PELVIS_YAW: Keyframes = ((0.0, 0.06), (0.25, 0.0), (0.5, -0.06), (0.75, 0.0))
PELVIS_ROLL: Keyframes = ((0.2, -0.03), (0.45, 0.0), (0.7, 0.03), (0.95, 0.0))
LEAN = 0.53
"""Lean of the pelvis in a turn, relative to the balancing lean, as in walking humans."""

TAIL_YAW: Keyframes = ((0.0, -1.0), (0.25, 0.0), (0.5, 1.0), (0.75, 0.0))
TAIL_SWING = (0.09, 0.04, 0.04, 0.04, 0.04)
"""Amplitude of each joint in radians. The first exceeds the pelvis's yaw, so that the tail swings against it."""

TAIL_LAG = 0.04
"""Delay of each joint of the tail after the previous one, in strides."""

TAIL_BEND, CHEST_BEND, NECK_BEND = 0.12, 0.1, 0.075
"""Bend into a turn at each joint, in radians per rad/s."""

DUTY = 0.62
"""Fraction of a stride for which a foot is on the ground."""

SWING = (DUTY + 0.02, 0.98)
"""Phases between which a foot moves forward: from leaving the ground to just before touching down."""

FOOT_LIFT: Keyframes = ((0.0, 0.0), (DUTY, 0.0), (0.78, 0.1))
FOOT_ASIDE: Keyframes = ((0.0, 0.0), (DUTY, 0.0), (0.78, 0.05))
"""Metres upwards, and metres outwards around the other leg."""

FOOT_PITCH: Keyframes = ((0.0, 0.0), (0.44, 0.0), (0.7, -0.9), (0.98, 0.0))
"""Pitch of the toes upwards in radians: the foot rolls over its tip before it leaves the ground."""

METATARSUS: Keyframes = ((0.0, 0.3), (0.3, 0.15), (0.58, -0.2), (0.8, 0.75))
"""Angle in radians by which the metatarsus leans back from the line between hip and toes."""


class Step(NamedTuple):
    """The motion of a foot.

    Attributes:
        position: Position of the foot's joint, the root of the toes, shape ``(T, 3)``.
        orientation: Orientation of the foot, shape ``(T, 4)``.
        yaw: Heading of the foot, shape ``(T,)``.
        phase: Phase of the foot's stride, which begins when it touches down, shape ``(T,)``.
    """

    position: Tensor
    orientation: Tensor
    yaw: Tensor
    phase: Tensor


def trex_corpus() -> list[MotionClip]:
    """Generate 11 s of loops: walking straight, two turns to the left, and their mirror images.

    Example:
        >>> [round(float(clip.cycle.turn), 1) for clip in trex_corpus()]
        [0.0, 1.1, 2.2, -1.1, -2.2]
    """
    left = [trex_walk(speed, turn_rate) for speed, turn_rate in LEFT_TURNS]
    return [trex_walk(*STRAIGHT), *left, *(clip.mirrored() for clip in left)]


def trex_walk(speed: float, turn_rate: float) -> MotionClip:
    """Walk straight or along a circular arc, in a loop that begins at the origin.

    Args:
        speed: Speed of the hips in m/s.
        turn_rate: Turn rate to the left in rad/s.

    Raises:
        ValueError: If the speed is negative, the steps are too long for the legs, or the loop turns by half a circle.

    Reference:
        Alexander, Estimates of speeds of dinosaurs, 1976, https://doi.org/10.1038/261129a0.
        van Bijlert et al., Natural frequency method: estimating the preferred walking speed of Tyrannosaurus rex based
        on tail natural frequency, 2021, https://doi.org/10.1098/rsos.201441.
    """
    duration = STRIDES * STRIDE_TIME
    if not speed >= 0:
        raise ValueError(f"speed={speed} is backwards, or nothing at all: pass 0 or more m/s")
    if not abs(turn_rate) * duration < torch.pi:
        raise ValueError(f"turn_rate={turn_rate} turns a loop half around: pass less than {torch.pi / duration:.2f}")
    time = torch.arange(round(duration * FPS) + 1, dtype=torch.float64) / FPS
    phase = time / STRIDE_TIME
    path = _path(time, speed, turn_rate)
    place, pelvis = _pelvis(phase, speed, turn_rate)
    position = path.points(place)
    orientation = path.quaternions(pelvis)
    still = about_z(torch.zeros_like(phase))
    joints = {
        **_front(phase, place, pelvis, turn_rate),
        **{"right_shoulder": still, "left_shoulder": still},
        **_tail(phase, turn_rate),
        **_leg("right", position, orientation, path.turn, _step("right", phase, speed, turn_rate)),
        **_leg("left", position, orientation, path.turn, _step("left", phase, speed, turn_rate)),
    }
    if not all(joint.isfinite().all() for joint in joints.values()):
        raise ValueError(f"speed={speed}, turn_rate={turn_rate} asks for longer steps than the legs allow: pass less")
    moving = [joints[name] for name in joint_layout("trex").names[1:]]
    return MotionClip("trex", torch.cat([position, orientation, *moving], dim=-1), FPS, loop=True)


def _path(time: Tensor, speed: float, turn_rate: float) -> Placement:
    """Arc from the origin along x: its chord has length v t sinc(w t / 2) and direction w t / 2."""
    turn = turn_rate * time
    chord = speed * time * torch.sinc(turn / 2 / torch.pi)
    return Placement(turn, chord.unsqueeze(-1) * torch.stack([(turn / 2).cos(), (turn / 2).sin()], dim=-1))


def _walking(speed: float) -> float:
    """Share of a full walk, from 0 on the spot to 1."""
    return min(speed / FULL_WALK, 1.0)


def _width(speed: float) -> float:
    """Distance in metres between the feet."""
    return STILL_WIDTH + _walking(speed) * (STEP_WIDTH - STILL_WIDTH)


def _pelvis(phase: Tensor, speed: float, turn_rate: float) -> tuple[Tensor, Tensor]:
    """Position ``(T, 3)`` and orientation ``(T, 4)`` of the pelvis relative to the path."""
    surge = _walking(speed) * smooth(SURGE, phase)
    sway = _width(speed) / STEP_WIDTH * smooth(SWAY, phase)
    place = torch.stack([surge, sway, HEIGHT + smooth(BOB, phase)], dim=-1)
    lean = speed * turn_rate / GRAVITY
    return place, multiply(about_z(smooth(PELVIS_YAW, phase)), about_x(smooth(PELVIS_ROLL, phase) - LEAN * lean))


def _front(phase: Tensor, place: Tensor, pelvis: Tensor, turn_rate: float) -> dict[str, Tensor]:
    """Chest, neck and head: the chest turns like a beam so that the head at its end keeps its height and line."""
    beam_turn, neck = (about_z(torch.full_like(phase, bend * turn_rate)) for bend in (CHEST_BEND, NECK_BEND))
    offset = {name: _offset(name).expand(len(phase), 3) for name in ("chest", "lower_neck", "upper_neck", "head")}
    neck_to_head = offset["upper_neck"] + rotate(neck, offset["head"])
    beam = rotate(beam_turn, offset["lower_neck"] + rotate(neck, neck_to_head))
    rest = torch.tensor([0.0, 0.0, HEIGHT], dtype=torch.float64)
    _, y, z = (rest + offset["chest"] + beam - place - rotate(pelvis, offset["chest"])).unbind(-1)
    length = torch.linalg.vector_norm(beam, dim=-1)
    wanted = torch.stack([(length**2 - y**2 - z**2).sqrt(), y, z], dim=-1)
    # The cross product equals the rotation vector up to third order in its small angle.
    steadying = from_rotation_vector(torch.linalg.cross(beam, wanted) / length.unsqueeze(-1) ** 2)
    chest = multiply(steadying, beam_turn)
    bent = about_z(torch.full_like(phase, (CHEST_BEND + 2 * NECK_BEND) * turn_rate))
    head = multiply(inverse(multiply(chest, multiply(neck, neck))), bent)
    return {"chest": multiply(inverse(pelvis), chest), "lower_neck": neck, "upper_neck": neck, "head": head}


def _tail(phase: Tensor, turn_rate: float) -> dict[str, Tensor]:
    """Joints of the tail: a wave that runs down the tail."""
    yaws = [swing * smooth(TAIL_YAW, phase - TAIL_LAG * joint) for joint, swing in enumerate(TAIL_SWING)]
    return {f"tail_{joint}": about_z(yaw - TAIL_BEND * turn_rate) for joint, yaw in enumerate(yaws, start=1)}


def _step(side: str, phase: Tensor, speed: float, turn_rate: float) -> Step:
    """Motion of a foot, which stands beside the path in stance, rolls over its tip, and swings to its next foothold.

    The tip is a sphere that rolls without sliding: it advances by its radius times the angle.
    """
    start = 0.0 if side == "right" else 0.5
    elapsed = phase - start
    count = elapsed.floor()
    elapsed = elapsed % 1
    progress = minimum_jerk((elapsed - SWING[0]) / (SWING[1] - SWING[0]))
    ground = _plant(side, start + count + progress, speed, turn_rate)
    pitch, lift, aside = (halting(keyframes, elapsed) for keyframes in (FOOT_PITCH, FOOT_LIFT, FOOT_ASIDE))
    pitch = pitch * (1 + _walking(speed)) / 2
    orientation = ground.quaternions(about_y(-pitch))
    tip, radius = _tip(side)
    moved = torch.stack([-radius * pitch, aside if side == "left" else -aside, radius + lift], dim=-1)
    position = ground.points(moved) - rotate(orientation, tip.expand(len(phase), 3))
    return Step(position, orientation, ground.turn, elapsed)


def _plant(side: str, touchdown: Tensor, speed: float, turn_rate: float) -> Placement:
    """Position and heading on the ground of the tip of a foot that touches down at a phase.

    In a turn the feet are outside the path of the hips, so that the body balances while leaning inwards.
    """
    path = _path((touchdown + DUTY / 2) * STRIDE_TIME, speed, turn_rate)
    aside = (0.5 if side == "left" else -0.5) * _width(speed) - HEIGHT * speed * turn_rate / GRAVITY
    beside = torch.tensor([TOE_AHEAD, aside], dtype=torch.float64).expand(len(touchdown), 2)
    return path.after(Placement(torch.zeros_like(touchdown), beside))


def _leg(side: str, position: Tensor, orientation: Tensor, heading: Tensor, step: Step) -> dict[str, Tensor]:
    r"""Inverse kinematics from pelvis to foot, in the plane through hip and toes that turns half as far as the foot.

    Angles in that plane are forward from straight down. The metatarsus follows its keyframes. Thigh :math:`a` and shank
    :math:`b` then form a triangle with the line :math:`r` from hip to ankle, with the knee in front:

    .. math:: \cos(\alpha_{hip} - \alpha_r) = \frac{a^2 + r^2 - b^2}{2 a r}

    Args:
        side: ``"right"`` or ``"left"``.
        position: Position of the pelvis, shape ``(T, 3)``.
        orientation: Orientation of the pelvis, shape ``(T, 4)``.
        heading: Heading of the path, shape ``(T,)``.
        step: Motion of the foot.
    """
    hip = position + rotate(orientation, _offset(f"{side}_hip").expand_as(position))
    yaw = (heading + step.yaw) / 2
    x, y, z = rotate(about_z(-yaw), step.position - hip).unbind(-1)
    plane = multiply(about_z(yaw), about_x(torch.atan2(y, -z)))
    down = torch.hypot(y, z)
    (thigh, thigh_rest), (shank, shank_rest), (metatarsus, metatarsus_rest) = (
        _bone(f"{side}_{end}") for end in ("knee", "ankle", "toe")
    )
    foot_angle = torch.atan2(x, down) + smooth(METATARSUS, step.phase)
    x = x - metatarsus * foot_angle.sin()
    down = down - metatarsus * foot_angle.cos()
    line = torch.hypot(x, down)
    hip_angle = torch.atan2(x, down) + torch.acos((thigh**2 + line**2 - shank**2) / (2 * thigh * line))
    knee_angle = torch.atan2(x - thigh * hip_angle.sin(), down - thigh * hip_angle.cos())
    turns = [hip_angle - thigh_rest, knee_angle - shank_rest, foot_angle - metatarsus_rest]
    return {
        f"{side}_hip": multiply(inverse(orientation), multiply(plane, about_y(-turns[0]))),
        f"{side}_knee": (turns[1] - turns[0]).unsqueeze(-1),
        f"{side}_ankle": (turns[2] - turns[1]).unsqueeze(-1),
        f"{side}_toe": multiply(inverse(multiply(plane, about_y(-turns[2]))), step.orientation),
    }


def _offset(body: str) -> Tensor:
    """Position of a body in its parent's frame, shape ``(3,)``."""
    return torch.tensor(character_model("trex").body(body).pos)


def _bone(end: str) -> tuple[float, float]:
    """Length of the bone that ends at a body, and its angle from straight down in the rest pose."""
    x, _, z = _offset(end)
    return float(torch.hypot(x, z)), float(torch.atan2(x, -z))


def _tip(side: str) -> tuple[Tensor, float]:
    """Centre of the sphere at the end of the middle toe, shape ``(3,)``, and its radius."""
    toe = character_model("trex").geom(f"{side}_toe")
    radius, half_length, _ = toe.size
    return torch.tensor(toe.pos) + torch.tensor([half_length, 0.0, 0.0], dtype=torch.float64), float(radius)
