import math

import pytest
import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import import_motion
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.inspection.signals import unwrapped
from torchrl_mcp.envs.motions.inspection.statistics import GaitStatistics, gait_statistics
from torchrl_mcp.envs.rotations import about_x, about_y, about_z, multiply

STRIDE = 1.2


def puppet(*, fps=100.0, seconds=12.0, turn_rate=0.0):
    """A humanoid whose limbs swing like pendulums while it glides along at 0.9 m/s."""
    time = torch.arange(round(seconds * fps) + 1, dtype=torch.float64) / fps
    phase = 2 * math.pi * time / STRIDE
    model = character_model("humanoid")
    qpos = torch.from_numpy(model.qpos0).repeat(len(time), 1)
    yaw = turn_rate * time
    across = 0.02 * phase.cos()
    if turn_rate:
        qpos[:, 0], qpos[:, 1] = 0.9 / turn_rate * yaw.sin(), 0.9 / turn_rate * (1 - yaw.cos())
    else:
        qpos[:, 0], qpos[:, 1] = 0.9 * time, across
    qpos[:, 2] += 0.015 * (2 * phase).cos()
    qpos[:, 3:7] = about_z(yaw + 0.05 * phase.cos())

    def turn(joint, quaternion):
        start = model.joint(joint).qposadr[0]
        qpos[:, start : start + 4] = quaternion

    def bend(joint, angle):
        qpos[:, model.joint(joint).qposadr[0]] = angle

    turn("chest", multiply(about_z(-0.09 * phase.cos()), about_x(-0.03 * phase.sin() - 0.04)))
    for side, sign in (("right", 1), ("left", -1)):
        turn(f"{side}_hip", about_y(-0.4 * sign * phase.cos()))
        turn(f"{side}_ankle", about_y(-0.2 * sign * phase.cos()))
        bend(f"{side}_knee", -0.2 - 0.1 * sign * phase.sin())
        turn(f"{side}_shoulder", about_y(0.3 * sign * phase.cos()))
        bend(f"{side}_elbow", 0.5 + 0.25 * sign * phase.cos())
    return MotionClip("humanoid", qpos, fps)


def close(value, expected, within):
    return value == pytest.approx(expected, abs=within)


def test_a_puppet_is_measured_as_it_was_made():
    medians = gait_statistics(puppet()).medians()
    assert close(medians["stride_time"], STRIDE, 0.01)
    assert close(medians["speed"], 0.9, 0.01)
    assert close(medians["turn_rate"], 0.0, 0.01)
    assert close(medians["step_width"], 2 * 0.084887, 0.02)
    assert close(medians["bob"], 0.03, 1e-3)
    assert close(medians["sway"], 0.04, 2e-3)
    assert close(medians["pelvis_yaw"], math.degrees(0.1), 0.2)
    assert close(medians["shoulder_yaw"], math.degrees(0.08), 0.2)
    assert close(medians["yaw_correlation"], -1.0, 0.01)
    assert close(medians["trunk_roll"], math.degrees(0.06), 0.2)
    assert close(medians["trunk_lean"], math.degrees(0.04), 0.2)
    assert close(medians["thigh_forward"], math.degrees(0.4), 0.3)
    assert close(medians["thigh_back"], -math.degrees(0.4), 0.3)
    assert close(medians["knee_swing"], math.degrees(0.3), 0.3)
    assert close(medians["arm_swing"], math.degrees(0.6), 0.6)
    assert close(medians["elbow_mean"], math.degrees(0.5), 0.3)
    assert close(medians["elbow_swing"], math.degrees(0.5), 0.5)
    assert close(medians["slide"], 0.9, 0.9)


def test_a_turning_puppet_turns_at_its_rate_and_keeps_its_speed():
    medians = gait_statistics(puppet(turn_rate=-0.6)).medians()
    assert close(medians["turn_rate"], -0.6, 0.01)
    assert close(medians["speed"], 0.9, 0.01)


def test_in_the_mirror_only_turns_and_lean_are_reversed():
    clip = puppet(turn_rate=0.4)
    medians, mirrored = gait_statistics(clip).medians(), gait_statistics(clip.mirrored()).medians()
    for name in ("turn_rate", "trunk_lean"):
        mirrored[name] *= -1
    assert mirrored == pytest.approx(medians, abs=1e-6)


def test_strides_are_kept_by_a_mask():
    statistics = gait_statistics(puppet())
    half = torch.arange(len(statistics.speed)) < 5
    assert len(statistics.select(half).bob) == 5


def test_a_clip_without_strides_gives_none():
    still = puppet(seconds=1.0).section(0.0, 0.3)
    assert all(len(field) == 0 for field in gait_statistics(still))


def test_unwrapped_angles_go_on_beyond_a_full_turn():
    angles = torch.linspace(0, 20, 100, dtype=torch.float64)
    torch.testing.assert_close(unwrapped(torch.atan2(angles.sin(), angles.cos())), angles)


PUBLISHED = {
    "stride_time": (1.16, 0.08),
    "stance": (0.645, 0.02),
    "double_support": (0.29, 0.03),
    "bob": (0.031, 0.005),
    "thigh_forward": (28, 2),
    "thigh_back": (-14, 2),
    "knee_swing": (72, 3),
    "ankle_dorsiflexion": (17, 3),
    "pitch_strike": (19, 3),
    "pitch_toe_off": (-70, 6),
    "pelvis_yaw": (8, 2),
    "pelvis_list": (9, 2),
    "shoulder_yaw": (7, 2),
    "arm_swing": (36, 4),
    "elbow_mean": (22, 4),
    "toe_clearance": (0.10, 0.012),
    "slide": (0.025, 0.015),
}
"""Of straight human walking near 1 m/s, with how far a median over these three recordings may be from it."""


def test_recorded_walking_measures_as_published(mocap):
    names = ("humanoid3d_long_walk1.txt", "humanoid3d_long_walk2.txt", "humanoid3d_long_walk3.txt")
    clips = [import_motion(mocap / "deepmimic" / name, "humanoid", rate=60.0) for name in names]
    strides = GaitStatistics(*(torch.cat(fields) for fields in zip(*map(gait_statistics, clips), strict=True)))
    straight = (strides.turn_rate.abs() < 0.35) & (strides.speed > 0.85) & (strides.speed < 1.35)
    medians = strides.select(straight).medians()
    outside = {
        name: medians[name] for name, (value, within) in PUBLISHED.items() if abs(medians[name] - value) > within
    }
    assert not outside
