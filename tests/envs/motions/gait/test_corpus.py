from itertools import pairwise

import pytest
import torch

from torchrl_mcp.envs.motions.gait.corpus import turning_clips, walking_corpus
from torchrl_mcp.envs.motions.inspection.signals import smoothed, unwrapped
from torchrl_mcp.envs.rotations import heading

# Of the paper's corpus: quantiles of the speed in m/s and of the absolute turn rate in rad/s.
SPEEDS = {0.05: 0.38, 0.5: 0.92, 0.95: 1.42}
TURN_RATES = {0.5: 0.50, 0.9: 1.32, 0.95: 1.61, 0.99: 2.92}


def speed_and_turn_rate(clip, window):
    """Speed in m/s along the heading, and turn rate in rad/s, smoothed over a window in seconds, each ``(T,)``."""
    yaw = smoothed(unwrapped(heading(clip.qpos[:, 3:7])), clip.fps, window)
    forward = (clip.qvel[:, :2] * torch.stack([yaw.cos(), yaw.sin()], dim=-1)).sum(-1)
    return smoothed(forward, clip.fps, window), torch.gradient(yaw, spacing=1 / clip.fps)[0]


def quantiles(values, expected):
    return [float(values.quantile(at)) for at in expected], list(expected.values())


@pytest.mark.parametrize("seed", [0, 1])
def test_speeds_and_turn_rates_are_distributed_as_in_the_papers_corpus(seed):
    clips = walking_corpus("biped", seed)
    measured = [speed_and_turn_rate(clip, window=0.6) for clip in clips.values()]
    speed, turn_rate = (torch.cat(values) for values in zip(*measured, strict=True))
    assert quantiles(speed, SPEEDS)[0] == pytest.approx(quantiles(speed, SPEEDS)[1], abs=0.1)
    found, expected = quantiles(turn_rate.abs(), TURN_RATES)
    assert found == pytest.approx(expected, rel=0.15)
    assert float(speed.mean()) == pytest.approx(0.95, abs=0.06)
    assert 0.02 < float((speed < 0.1).double().mean()) < 0.05
    assert 0.1 < float((turn_rate.abs() < 0.15).double().mean()) < 0.25
    assert float(turn_rate.mean()) == pytest.approx(0.0, abs=1e-6)


def test_the_corpus_is_as_long_as_the_papers_and_half_of_it_is_the_mirror_image_of_the_other():
    clips = walking_corpus("biped", 0)
    assert sum(clip.duration for clip in clips.values()) == pytest.approx(229.6)
    originals = [name for name in clips if not name.endswith("_mirrored")]
    assert len(clips) == 2 * len(originals)
    for name in originals:
        assert torch.equal(clips[name].mirrored().qpos, clips[f"{name}_mirrored"].qpos)


def test_a_seed_makes_the_same_corpus_and_another_seed_another():
    one, same, other = (torch.cat([clip.qpos for clip in walking_corpus("biped", seed).values()]) for seed in (3, 3, 4))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_there_are_seven_loops_one_ahead_and_three_to_either_side(character):
    clips = turning_clips(character)
    rates = {name: float(clip.cycle.turn) / clip.duration for name, clip in clips.items()}
    assert all(clip.loop for clip in clips.values())
    assert rates["forward"] == pytest.approx(0.0, abs=1e-6)
    left = sorted(rate for name, rate in rates.items() if name.startswith("left"))
    right = sorted(-rate for name, rate in rates.items() if name.startswith("right"))
    assert len(left) == 3
    assert left == pytest.approx(right)
    assert left[0] > 0.3
    assert all(b - a > 0.3 for a, b in pairwise(left))
