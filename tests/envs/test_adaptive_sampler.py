"""Moments at which episodes end are drawn more often: the weights of the definition, their memory and the lead."""

import pytest
import torch

from torchrl_mcp.envs.adaptive_sampler import AdaptiveSampler
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary


@pytest.fixture
def sampler():
    """Of a clip of 2 s and one of 3.5 s, which is drawn three times as often."""
    rest = torch.from_numpy(CHARACTERS["biped"].spec().compile().qpos0)
    clips = {str(seconds): MotionClip("biped", rest.repeat(round(30 * seconds) + 1, 1), 30.0) for seconds in (2.0, 3.5)}
    return AdaptiveSampler(MotionLibrary(clips, {"2.0": 1.0, "3.5": 3.0}))


def moments(sampler):
    clips, times = sampler.draw(40_000, torch.Generator().manual_seed(0))
    return [times[clips == clip] for clip in (0, 1)]


def test_before_any_failure_clips_are_drawn_as_the_library_does(sampler):
    _, longer = moments(sampler)
    assert len(longer) / 40_000 == pytest.approx(0.75, abs=0.01)


def test_a_period_where_episodes_end_is_drawn_from_the_second_before_it_on(sampler):
    sampler.failures[:] = 0.0
    sampler.failures[2 + 2] = 1.0  # the third second of the longer clip
    two, times = moments(sampler)
    assert not len(two)
    assert 1.0 <= times.min() < 1.05
    assert 2.95 < times.max() <= 3.0
    assert ((times - 2.0).abs() < 0.5).double().mean().item() == pytest.approx(0.75, abs=0.01)  # a triangle


def test_failures_are_forgotten_in_a_hundred_seconds(sampler):
    clip, time = torch.tensor([0]), torch.tensor([0.5]).double()
    sampler.count(clip, time, torch.tensor([True]))
    failures, steps = sampler.failures[0].item(), sampler.steps[0].item()
    for _ in range(3000):
        sampler.count(torch.tensor([1]), time, torch.tensor([False]))
    assert sampler.failures[0].item() == pytest.approx(failures * 0.9997**3000)
    assert sampler.steps[0].item() == pytest.approx(steps * 0.9997**3000)


def test_starts_are_uniform_over_a_loop_and_pile_up_at_the_beginning_of_other_clips_alone():
    rest = torch.from_numpy(CHARACTERS["biped"].spec().compile().qpos0).repeat(37, 1)
    clips = {name: MotionClip("biped", rest, 30.0, loop=name == "loop") for name in ("loop", "once")}
    loop, once = moments(AdaptiveSampler(MotionLibrary(clips)))
    sixths = torch.histc(loop, 6, 0.0, 1.2) / len(loop)
    torch.testing.assert_close(sixths, torch.full_like(sixths, 1 / 6), rtol=0, atol=0.01)
    # A moment m is uniform over 1.2 s, and its lead over 1 s is longer than m with probability (1 - m), below 1.
    assert (once == 0).double().mean().item() == pytest.approx(0.5 / 1.2, abs=0.01)
    assert 1.18 < once.max() < 1.2
