import math

import torch
from refusals import refused
from tensordict.nn import TensorDictModule

from torchrl_mcp.envs import Imitation
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions import MotionClip
from torchrl_mcp.evaluation.clips import follow_each

IDLE = TensorDictModule(lambda goal: torch.zeros(len(goal), 17), in_keys=["goal"], out_keys=["action"])
TERMS = {"pose": {"weight": 1.0, "scale": 3.0}}


def sliding(speed, seconds):
    """The biped's rest pose, sliding forward."""
    qpos = torch.from_numpy(CHARACTERS["biped"].spec().compile().qpos0).repeat(round(30 * seconds) + 1, 1)
    qpos[:, 0] = speed / 30 * torch.arange(len(qpos))
    return MotionClip("biped", qpos, 30.0, loop=False)


def make(num_envs=6, **kwargs):
    clips = {"standing": sliding(0.0, 2.0), "leaving": sliding(3.0, 1.0), "short": sliding(0.0, 0.3)}
    settings = {"terms": TERMS, "switch_interval": math.inf, "max_episode_steps": 15, "num_threads": 1, **kwargs}
    return Imitation("biped", clips, num_envs, **settings)


def test_a_character_that_stands_follows_who_stands_and_loses_who_leaves():
    standing, leaving, short = follow_each(IDLE, make())
    assert (standing.clip, standing.seconds, standing.episodes) == ("standing", 2.0, 2)
    assert (standing.completed, standing.length) == (1.0, 15)
    assert standing.tracking_error < 0.02
    # It moves with 3 m/s, but is soon left behind by more than 0.3 m.
    assert leaving.completed == 0
    assert 0.1 < leaving.tracking_error < 0.3
    assert (short.completed, short.length) == (1.0, 3.0)  # from 2.25 and 6.75 of 9 frames to the last but two: 5 and 1


def test_episodes_begin_early_enough_to_end_within_the_clip():
    env = make(12)
    begun = []
    beginning = env.beginning
    env.beginning = lambda clips, times: begun.append((clips, times)) or beginning(clips, times)
    follow_each(IDLE, env)
    each = [0] * 4 + [1] * 4 + [2] * 4
    [times] = [times for clips, times in begun if clips.tolist() == each]
    room = torch.tensor([2.0 - 17 / 30, 1.0 - 17 / 30, 0.3]).repeat_interleave(4)
    torch.testing.assert_close(times / room, torch.tensor([0.125, 0.375, 0.625, 0.875]).double().repeat(3))


def test_changing_references_and_uneven_numbers_are_refused():
    refused(lambda: follow_each(IDLE, make(switch_interval=5.0)), "switch_interval=inf")
    refused(lambda: follow_each(IDLE, make(clip_end="switch")), "clip_end='truncate'")
    refused(lambda: follow_each(IDLE, make(7)), "num_envs=7")
