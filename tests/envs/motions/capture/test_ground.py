"""The ground of an import is where feet stand, whatever else the body does, or else where it rests."""

import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.ground import grounded
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import stride

FPS = 60.0

RECORDINGS = [
    "biped/biped3d_walk.txt",
    "cmu/02_01.amc",
    "cmu/02_02.amc",
    "deepmimic/humanoid3d_jog.txt",
    "deepmimic/humanoid3d_long_walk1.txt",
    "deepmimic/humanoid3d_long_walk2.txt",
    "deepmimic/humanoid3d_long_walk3.txt",
    "deepmimic/humanoid3d_walk.txt",
    "sfu/0005_Walking001.bvh",
    "sfu/0005_Walking001_retargeted_deepmimic_60hz.txt",
]

SHORT = [file for file in RECORDINGS if "long" not in file and not file.startswith("sfu")]


def feet_of(clip):
    """Height of the lowest corner or sphere, tilt in degrees and speed of each foot over time, by MuJoCo."""
    model = character_model(clip.character)
    data = mujoco.MjData(model)
    feet = [model.body(foot).id for foot in CHARACTERS[clip.character].feet]
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(8, 3)
    heights, places, tilts = [], [], []
    for data.qpos in clip.qpos.numpy():
        mujoco.mj_kinematics(model, data)
        lowest = dict.fromkeys(feet, math.inf)
        for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
            if (foot := model.geom_bodyid[geom]) in lowest:
                size, matrix = model.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)
                sphere = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
                reach = size[0] if sphere else -min((corners * size) @ matrix[2])
                lowest[foot] = min(lowest[foot], data.geom_xpos[geom, 2] - reach)
        heights.append(list(lowest.values()))
        places.append(data.xpos[feet].copy())
        tilts.append(data.xmat[feet, 8].copy())
    speeds = np.linalg.norm(np.gradient(np.array(places), 1 / clip.fps, axis=0), axis=-1)
    return np.array(heights), np.degrees(np.arccos(np.minimum(tilts, 1))), speeds


@pytest.mark.parametrize(
    ("character", "file"),
    [
        *((character, file) for character in ("humanoid", "biped") for file in RECORDINGS),
        *(("g1", file) for file in SHORT),
    ],
)
def test_soles_that_are_flat_and_still_are_on_the_ground(mocap, robot, file, character):
    if character == "g1":
        robot("g1")
    heights, tilts, speeds = feet_of(imported(mocap / file, character, rate=FPS).clip)
    standing = heights[(tilts < 8) & (speeds < 0.15)]
    assert len(standing)
    assert abs(np.median(standing)) < 0.005


def on_ground(qpos, **options):
    times = torch.arange(len(qpos), dtype=torch.float64) / FPS
    return grounded("humanoid", qpos, times, **options)


STANDING = 0.881416
"""Height of the root of the humanoid that stands straight."""

THIGH, SHANK = 0.421546, 0.40987


def sides(**joints):
    return {f"{side}_{joint}": value for side in ("left", "right") for joint, value in joints.items()}


def test_standing_on_the_toes_and_jumping_for_most_of_the_time_lift_nobody(posed, turned):
    """The feet stand for a fifth of the time; toes that push into the ground are the lowest points of all."""
    jump = [STANDING + 4.0 * frame / FPS - 9.81 / 2 * (frame / FPS) ** 2 for frame in range(49)]
    toes = sides(ankle=turned([0, 1, 0], 40))
    frames = [((0, 0, STANDING), {})] * 36 + [((0, 0, STANDING), toes)] * 96 + [((0, 0, z), {}) for z in jump]
    qpos = posed(frames)
    qpos[:, 2] += 0.7
    qpos, note = on_ground(qpos)
    assert note == ""
    assert float(qpos[0, 2]) == pytest.approx(STANDING, abs=1e-6)


def test_who_squats_stands_at_the_beginning(posed, turned):
    """The root sinks by a quarter of a metre, and the feet do not."""
    frames = []
    for degrees in np.linspace(0, 50, 90):
        angle = math.radians(degrees)
        bend = math.asin(THIGH / SHANK * math.sin(angle))
        legs = sides(
            hip=turned([0, 1, 0], -degrees), knee=-(angle + bend), ankle=turned([0, 1, 0], -math.degrees(bend))
        )
        sunk = THIGH * (1 - math.cos(angle)) + SHANK * (1 - math.cos(bend))
        frames.append(((0, 0, STANDING - sunk), legs))
    qpos = posed(frames)
    found, note = on_ground(qpos)
    assert qpos[0, 2] - qpos[-1, 2] > 0.25
    assert note == ""
    torch.testing.assert_close(found, qpos, rtol=0, atol=0.002)


GROUNDS = {
    "sinks": lambda t: -0.25 * t / 6,
    "rises": lambda t: 0.4 * t / 6,
    "has a step": lambda t: np.where(t < 3, 0.3, 0.0),
}


@pytest.mark.parametrize("ground", GROUNDS.values(), ids=GROUNDS)
def test_a_walk_whose_ground_sinks_or_rises_stands_on_the_ground_at_both_ends(ground):
    walk = stride("humanoid", 1.0, 0.0, strides=6).resampled(FPS)
    qpos = walk.qpos.clone()
    qpos[:, 2] += torch.from_numpy(ground(np.arange(len(qpos)) / FPS))
    found, note = on_ground(qpos)
    assert "levelled" in note
    heights, tilts, speeds = feet_of(MotionClip("humanoid", found, FPS))
    stands = (tilts < 8) & (speeds < 0.2)
    for part in (slice(60), slice(-60, None)):
        standing = heights[part][stands[part]]
        assert len(standing)
        assert abs(np.median(standing)) < 0.01
        assert abs(standing).max() < 0.03


def test_the_cycle_of_a_loop_is_not_levelled():
    walk = stride("humanoid", 1.0, 0.0, strides=2).resampled(FPS)
    qpos = walk.qpos.clone()
    qpos[:, 2] += 0.1 * torch.sin(torch.linspace(0, 2 * torch.pi, len(qpos), dtype=torch.float64))
    found, note = on_ground(qpos, loop=True)
    assert note == ""
    risen = found[:, 2] - qpos[:, 2]
    torch.testing.assert_close(risen, risen[:1].expand_as(risen))


def test_where_no_foot_stands_the_ground_is_where_the_body_rests_and_it_says_so(posed, turned, kinematics):
    """On the knees with a level trunk, upright thighs, and shanks that rise backwards from the knees."""
    knees = sides(hip=turned([0, 1, 0], -90), knee=-math.radians(105), ankle=turned([0, 1, 0], 60))
    qpos, note = on_ground(posed([((0, 0, 0.3), {"root": turned([0, 1, 0], 90), **knees})] * 60))
    places, _ = kinematics(MotionClip("humanoid", qpos, FPS), 30)
    height = THIGH + 0.05 - 0.045 * math.sin(math.radians(15))  # the radius of a shank, which begins below the knee
    for side in ("left", "right"):
        assert places[f"{side}_hip"][2] == pytest.approx(height, abs=1e-6)
    assert "knee" in note


def test_who_flies_all_the_time_touches_the_ground_at_the_lowest_moment(posed):
    seconds = np.arange(30) / FPS
    heights = 3.0 * seconds - 9.81 / 2 * seconds**2
    qpos, note = on_ground(posed([((3 * t, 0, 5 + z), {}) for t, z in zip(seconds, heights, strict=True)]))
    assert float(qpos[:, 2].min()) == pytest.approx(STANDING, abs=0.05)
    assert "lowest" in note


@pytest.mark.parametrize("fps", [24.0, 30.0, 120.0, 240.0])
def test_the_ground_does_not_depend_on_the_frame_rate(fps):
    walk = stride("humanoid", 1.0, 0.3, strides=4)
    heights = []
    for rate in (FPS, fps):
        clip = walk.resampled(rate)
        times = torch.arange(len(clip.qpos), dtype=torch.float64) / clip.fps
        heights.append(float(grounded("humanoid", clip.qpos, times)[0][0, 2]))
    assert heights[0] == pytest.approx(heights[1], abs=0.002)
