"""What the environment remembers for the policy, across steps, episodes, batches and interruptions."""

import pytest
import torch
from refusals import refused
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv, check_env_specs

from torchrl_mcp.envs import Holdout
from torchrl_mcp.methods.transforms import ClipAsOption, OptionMemory, TransformedCharacterEnv

LENGTHS = torch.tensor([[3], [5], [100]])


class Lengths(EnvBase):
    """Three environments whose episodes last 3, 5 and 100 steps."""

    batch_locked = True

    def __init__(self):
        super().__init__(device="cpu", batch_size=[3])
        one, flag = Unbounded((3, 1)), Binary(1, shape=(3, 1), dtype=torch.bool)
        self.observation_spec = Composite(observation=one.clone(), shape=(3,))
        self.action_spec, self.reward_spec = one.clone(), one.clone()
        self.full_done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(3,))
        self.steps = torch.zeros(3, 1)
        self.episode = {"clip": torch.tensor([2, 0, 1])}
        self.library = range(3)

    def _set_seed(self, seed):
        pass

    def _reset(self, tensordict=None, **kwargs):
        mask = tensordict.get("_reset", None) if tensordict is not None else None
        self.steps = self.steps * 0 if mask is None else self.steps.masked_fill(mask, 0)
        no = torch.zeros(3, 1, dtype=torch.bool)
        done = {"done": no, "terminated": no.clone(), "truncated": no.clone()}
        return TensorDict({"observation": self.steps.clone(), **done}, [3])

    def _step(self, tensordict):
        self.steps = self.steps + 1
        ended = self.steps >= LENGTHS
        done = {"done": ended, "terminated": ended.clone(), "truncated": torch.zeros_like(ended)}
        return TensorDict({"observation": self.steps.clone(), "reward": torch.ones(3, 1), **done}, [3])


def counting(tensordict):
    """Choose anew every second step since the last choice, and each time the next option."""
    begins = tensordict["held_steps"].remainder(2) == 0
    option = tensordict["held_option"] + begins
    action = torch.zeros(*tensordict.batch_size, 1)
    return tensordict.update({"begins": begins, "option": option, "action": action})


def remembering():
    return TransformedEnv(Lengths(), OptionMemory())


@pytest.mark.parametrize(
    "transform",
    [OptionMemory(), ClipAsOption(num_options=3)],
    ids=lambda t: type(t).__name__,
)
def test_the_specs_hold_what_is_shown(transform):
    check_env_specs(TransformedEnv(Lengths(), transform))


def test_an_option_is_held_until_the_policy_chooses_anew_or_the_episode_ends():
    rollout = remembering().rollout(8, counting, break_when_any_done=False)
    # A choice at every second step of an episode, and at its first.
    assert rollout["begins"].int().tolist() == [
        [1, 0, 1, 1, 0, 1, 1, 0],
        [1, 0, 1, 0, 1, 1, 0, 1],
        [1, 0, 1, 0, 1, 0, 1, 0],
    ]
    assert rollout["option"].tolist() == [
        [1, 1, 2, 1, 1, 2, 1, 1],
        [1, 1, 2, 2, 3, 1, 1, 2],
        [1, 1, 2, 2, 3, 3, 4, 4],
    ]


def test_what_is_shown_after_a_step_is_what_the_policy_sees_next_unless_the_episode_ended():
    rollout = remembering().rollout(8, counting, break_when_any_done=False)
    ended = rollout["next", "done"].squeeze(-1)[:, :-1]
    for key in ("held_option", "held_steps"):
        before, after = rollout["next", key][:, :-1], rollout[key][:, 1:]
        assert torch.equal(before[~ended], after[~ended])
        assert not after[ended].any()
        assert before[ended].all()


def test_a_collector_carries_the_option_from_batch_to_batch():
    whole = remembering().rollout(9, counting, break_when_any_done=False)
    collector = Collector(
        remembering(), counting, frames_per_batch=9, total_frames=27, auto_register_policy_transforms=False
    )
    pieces = torch.cat([batch.clone() for batch in collector], dim=1)
    collector.shutdown()
    for key in ("option", "begins", "held_option", "held_steps"):
        assert torch.equal(pieces[key], whole[key]), key


def test_what_is_remembered_survives_an_interruption_and_the_reset_after_it():
    env = remembering()
    last = env.rollout(4, counting, break_when_any_done=False)[:, -1]["next"]
    state = env.transform.state_dict()

    resumed = remembering()
    resumed.transform.load_state_dict(state)
    first = resumed.reset()
    # The first environment is in the first step of its second episode, the others in the fourth of their first.
    for key in ("held_option", "held_steps"):
        assert torch.equal(first[key], last[key])
    assert first["held_steps"].tolist() == [1, 2, 2]
    assert not resumed.reset()["held_steps"].any()


def test_a_saved_memory_does_not_change_with_the_run():
    env = remembering()
    env.rollout(2, counting, break_when_any_done=False)
    saved = env.transform.get_extra_state()
    before = {key: value.clone() for key, value in saved.items()}
    env.rollout(3, counting, break_when_any_done=False, auto_reset=True)
    assert all(torch.equal(saved[key], before[key]) for key in before)


def test_the_clip_that_is_followed_says_which_option_acts_in_and_after_every_step():
    env = TransformedEnv(Lengths(), ClipAsOption(num_options=3))
    rollout = env.rollout(4, break_when_any_done=False)
    for key in ("option", ("next", "option")):
        assert rollout[key].tolist() == [[2] * 4, [0] * 4, [1] * 4]


def test_as_many_options_as_clips_are_needed():
    env = TransformedEnv(Lengths(), ClipAsOption(num_options=7))
    refused(lambda: env.observation_spec, "num_primitives=7", "3", "goal_number")


def test_environments_with_a_memory_are_put_into_a_state_and_saved_as_a_whole():
    env = TransformedCharacterEnv(Holdout(num_envs=2, directions=[0.0, 1.0], seed=0), OptionMemory())
    env.rollout(5, counting_ants)
    middle = env.get_state()
    saved = env.state_dict()
    whole = env.rollout(5, counting_ants, auto_reset=False, tensordict=env.reset(middle, set_state=True))
    assert not whole["held_steps"][:, 0].any()

    other = TransformedCharacterEnv(Holdout(num_envs=2, directions=[0.0, 1.0], seed=1), OptionMemory())
    other.load_state_dict(saved)
    continued = other.rollout(5, counting_ants)
    assert torch.equal(continued["next", "observation"], whole["next", "observation"])
    assert continued["held_steps"][:, 0].tolist() == [1, 1]


def test_a_state_for_some_environments_leaves_the_options_of_the_others():
    env = TransformedCharacterEnv(Holdout(num_envs=3, directions=[0.0, 1.0], seed=0), OptionMemory())
    held = env.rollout(5, counting_ants)["next", "held_option"][:, -1]
    assert held.all()
    env.reset(env.get_state().set("_reset", torch.tensor([[True], [False], [False]])), set_state=True)
    assert env.transform.get_extra_state()["held_option"].tolist() == [0, *held[1:].tolist()]


def counting_ants(tensordict):
    """As :func:`counting`, for ants."""
    return counting(tensordict).set("action", torch.full((*tensordict.batch_size, 8), 0.1))


def test_what_is_saved_when_some_episodes_have_just_begun_is_what_all_are_shown():
    env = remembering()
    state = env.reset()
    for _ in range(3):  # the first of three episodes ends
        step, state = env.step_and_maybe_reset(state.set("action", torch.zeros(3, 1)))
    assert step["next", "done"].flatten().tolist() == [True, False, False]
    for key, saved in env.transform.get_extra_state().items():
        assert torch.equal(saved, state[key]), key
        assert torch.equal(saved[1:], step["next", key][1:]), key
