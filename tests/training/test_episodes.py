import pytest
import torch
from tensordict import TensorDict

from torchrl_mcp.training.metrics import EpisodeStatistics


def batch(reward, done):
    reward, done = torch.as_tensor(reward), torch.as_tensor(done)
    following = TensorDict(reward=reward.unsqueeze(-1), done=done.unsqueeze(-1), batch_size=reward.shape)
    return TensorDict(next=following, batch_size=reward.shape)


def episodes_of(rewards, dones):
    """Return and length of all finished episodes, environment by environment, over a whole history ``(N, T)``."""
    finished = []
    for reward, done in zip(rewards.tolist(), dones.tolist(), strict=True):
        episode = []
        for r, d in zip(reward, done, strict=True):
            episode.append(r)
            if d:
                finished.append((sum(episode), len(episode)))
                episode = []
    return sorted(finished)


def test_an_episode_is_summed_across_batches():
    statistics = EpisodeStatistics(2)
    returns, lengths = statistics.update(batch([[1.0, 2.0], [10.0, 20.0]], [[False, False], [True, False]]))
    assert (returns.tolist(), lengths.tolist()) == ([10.0], [1.0])
    returns, lengths = statistics.update(batch([[3.0, 4.0], [30.0, 40.0]], [[True, True], [False, False]]))
    assert (returns.tolist(), lengths.tolist()) == ([6.0, 4.0], [3.0, 1.0])
    returns, lengths = statistics.update(batch([[5.0], [50.0]], [[False], [True]]))
    assert (returns.tolist(), lengths.tolist()) == ([140.0], [4.0])


@pytest.mark.parametrize("frames", [1, 7, 60])
def test_batches_of_any_length_give_the_episodes_of_the_whole_history(frames):
    generator = torch.Generator().manual_seed(frames)
    rewards = torch.randint(-5, 6, (4, 420), generator=generator).float()  # integers sum exactly
    dones = torch.rand(4, 420, generator=generator) < 0.05
    statistics, finished = EpisodeStatistics(4), []
    for reward, done in zip(rewards.split(frames, 1), dones.split(frames, 1), strict=True):
        returns, lengths = statistics.update(batch(reward, done))
        finished += zip(returns.tolist(), lengths.tolist(), strict=True)
    assert sorted(finished) == episodes_of(rewards, dones)


def test_no_episode_that_ended_gives_empty_tensors():
    returns, lengths = EpisodeStatistics(3).update(batch(torch.ones(3, 5), torch.zeros(3, 5, dtype=torch.bool)))
    assert returns.shape == lengths.shape == (0,)


def test_it_counts_the_steps_of_each_environment():
    statistics = EpisodeStatistics(2)
    for _ in range(3):
        statistics.update(batch(torch.zeros(2, 5), torch.ones(2, 5, dtype=torch.bool)))
    assert statistics.steps == 15
    continued = EpisodeStatistics(2)
    continued.load_state_dict(statistics.state_dict())
    assert continued.steps == 15


def test_its_state_continues_the_episodes_under_way():
    original, continued = EpisodeStatistics(2), EpisodeStatistics(2)
    original.update(batch([[1.0, 2.0], [3.0, 4.0]], [[False, False], [True, False]]))
    continued.load_state_dict(original.state_dict())
    ending = batch([[1.0], [1.0]], [[True], [True]])
    for statistics in (original, continued):
        returns, lengths = statistics.update(ending)
        assert (returns.tolist(), lengths.tolist()) == ([4.0, 5.0], [3.0, 2.0])


def test_what_is_restored_does_not_share_memory():
    original, copy = EpisodeStatistics(1), EpisodeStatistics(1)
    copy.load_state_dict(original.state_dict())
    original.update(batch([[1.0]], [[False]]))
    assert copy.returns.item() == copy.lengths.item() == 0
