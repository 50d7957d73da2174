import math

import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_states
from torchrl_mcp.envs.motions.contacts import contact_points
from torchrl_mcp.envs.motions.gait.generator import stride, walk
from torchrl_mcp.envs.motions.inspection.statistics import gait_statistics
from torchrl_mcp.envs.rotations import heading

WALKERS = ["humanoid", "biped"]
STRAIGHT = [(0.8, 0.0), (1.0, 0.0), (1.3, 0.0)]
TURNS = [(1.02, 0.5), (0.9, -1.0), (0.83, 1.3), (0.8, 1.6), (0.8, -1.6)]
"""At about 1.15 m/s - 0.25 m per rad, as people take turns."""


def steady(character, speed, turn_rate, seconds=8.0):
    frames = round(seconds * 60)
    return walk(character, torch.full((frames,), speed), torch.full((frames,), turn_rate))


def starting_and_stopping(character):
    """Stand, walk a curve at up to 1.2 m/s, stand again: 10 s."""
    time = torch.arange(601) / 60
    going = (0.5 - 0.5 * (math.pi * (time - 2).clamp(0, 1.5) / 1.5).cos()) * (
        0.5 + 0.5 * (math.pi * (time - 6).clamp(0, 1.5) / 1.5).cos()
    )
    return walk(character, 1.2 * going, 0.4 * going)


def feet(clip):
    states = body_states(clip.character, clip.qpos, clip.qvel)
    return [contact_points(clip.character, foot, states) for foot in CHARACTERS[clip.character].feet]


@pytest.fixture(scope="module")
def measured():
    """Statistics of every steady walk, measured once."""
    cases = [(character, *motion) for character in WALKERS for motion in STRAIGHT + TURNS]
    return {case: gait_statistics(steady(*case)) for case in cases}


@pytest.mark.parametrize(("speed", "turn_rate"), STRAIGHT + TURNS)
@pytest.mark.parametrize("character", WALKERS)
def test_a_walk_has_the_measures_of_human_walking(measured, human_bands, character, speed, turn_rate):
    means = {name: float(field.mean()) for name, field in measured[character, speed, turn_rate]._asdict().items()}
    arms = () if character == "humanoid" else ("arm_swing", "elbow_mean", "elbow_swing")
    bands = {name: band for name, band in human_bands.items() if name not in arms} | {"yaw_correlation": (-1, -0.5)}
    outside = {
        name: (round(means[name], 3), (low, high))
        for name, (low, high) in bands.items()
        if not low <= means[name] <= high
    }
    assert not outside


@pytest.mark.parametrize(("speed", "turn_rate"), STRAIGHT)
@pytest.mark.parametrize("character", WALKERS)
def test_strides_get_quicker_and_the_pelvis_bobs_more_with_speed(measured, character, speed, turn_rate):
    medians = measured[character, speed, turn_rate].medians()
    time = 1 / (0.42 + 0.44 * speed)
    assert 1.02 / 1.16 <= medians["stride_time"] / time <= 1.28 / 1.16
    bob = 0.022 * (speed * time) ** 2
    assert 0.018 / 0.031 <= medians["bob"] / bob <= 0.045 / 0.031


@pytest.mark.parametrize(("speed", "turn_rate"), STRAIGHT + TURNS)
@pytest.mark.parametrize("character", WALKERS)
def test_a_walk_has_the_speed_and_turn_rate_asked_for_and_leans_inwards(measured, character, speed, turn_rate):
    medians = measured[character, speed, turn_rate].medians()
    assert medians["speed"] == pytest.approx(speed, abs=0.05)
    assert medians["turn_rate"] == pytest.approx(turn_rate, abs=0.01)
    lean = 0.53 * math.degrees(math.atan(speed * turn_rate / 9.81))
    assert medians["trunk_lean"] == pytest.approx(lean, abs=1.5)


@pytest.mark.parametrize("character", WALKERS)
@pytest.mark.parametrize("turn_rate", [2.9, -2.9])
def test_the_slowest_walks_turn_almost_on_the_spot(character, turn_rate):
    clip = steady(character, 0.3, turn_rate)
    turned = heading(clip.qpos[:, 3:7]).diff()
    total = float(torch.atan2(turned.sin(), turned.cos()).sum())
    assert total == pytest.approx(turn_rate * clip.duration, abs=0.2)
    middle = clip.qpos[:, :2].mean(0)
    assert (clip.qpos[:, :2] - middle).norm(dim=-1).max() < 0.3


@pytest.mark.parametrize("motion", [*STRAIGHT, *TURNS, (0.3, 2.9), None])
@pytest.mark.parametrize("character", WALKERS)
def test_feet_stand_still_and_stay_above_the_ground(character, motion):
    clip = steady(character, *motion, seconds=4.0) if motion else starting_and_stopping(character)
    slowest = torch.full((len(clip.qpos),), torch.inf, dtype=torch.float64)
    for points in feet(clip):
        height = points.positions[..., 2]
        assert height.min() > -0.002
        speed = points.velocities[..., :2].norm(dim=-1)
        slowest = torch.minimum(slowest, speed.where(height < 0.004, torch.inf).amin(-1))
    assert slowest.quantile(0.99) < 0.03  # at every time, some point of a foot rests on the ground


@pytest.mark.parametrize("character", WALKERS)
def test_it_stands_before_it_starts_and_after_it_has_stopped(character):
    clip = starting_and_stopping(character)
    for still in (clip.qvel[:20], clip.qvel[-20:]):
        assert still.abs().max() < 0.05
    for points in feet(clip):
        assert points.positions[[0, -1], :, 2].amin(-1).abs().max() < 1e-3
    assert clip.qvel[:, :2].norm(dim=-1).max() > 1.1


@pytest.mark.parametrize("motion", [(1.3, 0.0), (0.75, 1.6), None])
@pytest.mark.parametrize("character", WALKERS)
def test_no_joint_jerks_when_a_foot_strikes(character, motion):
    clip = steady(character, *motion, seconds=4.0) if motion else starting_and_stopping(character)
    acceleration = clip.qvel.diff(dim=0) * clip.fps
    assert acceleration[:, :3].abs().max() < 15  # a corner in a velocity of 1 m/s would be 60 m/s^2 in one frame
    assert acceleration[:, 6:].abs().max() < 600


@pytest.mark.parametrize("character", WALKERS)
@pytest.mark.parametrize("turn_rate", [0.0, 0.7])
def test_strides_loop_without_a_seam(character, turn_rate):
    clip = stride(character, 1.0, turn_rate, strides=2)
    assert clip.loop
    torch.testing.assert_close(clip.cycle.qpos(clip.qpos[0]), clip.qpos[-1], atol=1e-6, rtol=0)
    assert float(clip.cycle.turn) == pytest.approx(turn_rate * clip.duration, abs=1e-6)


@pytest.mark.parametrize("character", WALKERS)
def test_a_left_turn_is_the_mirror_image_of_a_right_turn_half_a_stride_later(character):
    left, right = stride(character, 0.9, 0.8), stride(character, 0.9, -0.8).mirrored()
    half = torch.tensor(left.duration / 2, dtype=torch.float64)
    joints = slice(7, None)
    torch.testing.assert_close(left.at(half)[joints], right.qpos[0, joints], atol=1e-3, rtol=0)


def test_a_walk_is_the_same_at_any_frame_rate():
    coarse, fine = (walk("humanoid", torch.full((n,), 1.0), torch.full((n,), 0.5), fps=n - 1.0) for n in (61, 121))
    torch.testing.assert_close(coarse.qpos[:, :7], fine.qpos[::2, :7], atol=1e-3, rtol=0)
    torch.testing.assert_close(coarse.qpos, fine.qpos[::2], atol=0.02, rtol=0)  # a knee near straight is sensitive


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"character": "trex"}, r"character='trex' cannot walk like this: pass one of \('humanoid', 'biped'\)"),
        ({"speed": torch.ones(60)}, r"shapes \(60,\) and \(61,\)"),
        ({"speed": torch.full((61,), -0.1)}, "speed leaves the range of the generator: pass values from 0.0 to 1.6"),
        ({"turn_rate": torch.full((61,), torch.nan)}, "turn_rate leaves the range"),
        ({"fps": 10.0}, "fps=10.0 is too coarse"),
    ],
)
def test_what_cannot_be_walked_is_refused(arguments, message):
    fitting = {"character": "biped", "speed": torch.ones(61), "turn_rate": torch.zeros(61), "fps": 60.0}
    with pytest.raises(ValueError, match=message):
        walk(**{**fitting, **arguments})


@pytest.mark.parametrize("character", WALKERS)
def test_joints_stay_within_their_limits(character):
    model, clip = character_model(character), starting_and_stopping(character)
    for joint in range(1, model.njnt):
        if model.jnt_type[joint] == 3:
            angle = clip.qpos[:, model.jnt_qposadr[joint]]
            assert model.jnt_range[joint, 0] <= angle.min()
            assert angle.max() <= model.jnt_range[joint, 1]
