"""Choices that last for several steps, against the definitions in plain Python."""

from statistics import mean, pstdev, stdev

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_mcp.objectives import Advantages, SemiMarkovAdvantages

GOES_ON, TERMINATED, TRUNCATED = range(3)


class Value(nn.Module):
    """A value that the tests can read off: the sum of state and goal."""

    def forward(self, observation, goal):
        return observation.sum(-1, keepdim=True) + goal.sum(-1, keepdim=True)


def critic():
    return TensorDictModule(Value(), in_keys=["observation", "goal"], out_keys=["state_value"])


def trajectories(rewards, values, outcomes, begins):
    """Rows of steps; ``values`` are those of the states before the steps, and of the last one's next state."""
    rewards, values = torch.tensor(rewards), torch.tensor(values)
    outcomes, begins = torch.tensor(outcomes), torch.tensor(begins)
    ended = outcomes != GOES_ON
    # What follows an end is the beginning of another episode: the state that was cut off is worth something else.
    arrived = torch.where(ended, 10 + values[:, 1:], values[:, 1:])
    goal = torch.zeros(*rewards.shape, 1)
    following = {
        "observation": arrived.unsqueeze(-1),
        "goal": goal,
        "reward": rewards.unsqueeze(-1),
        "terminated": (outcomes == TERMINATED).unsqueeze(-1),
        "truncated": (outcomes == TRUNCATED).unsqueeze(-1),
        "done": ended.unsqueeze(-1),
    }
    state = {"observation": values[:, :-1].unsqueeze(-1), "goal": goal, "begins": begins}
    batch = TensorDict(state, batch_size=rewards.shape)
    return batch.set("next", TensorDict(following, batch_size=rewards.shape))


def estimates(batch, gamma, lmbda):
    """Advantage and target of every choice, row by row, from the definition."""
    flat = {key: batch["next", key].squeeze(-1).tolist() for key in ("reward", "terminated", "done", "observation")}
    values, begins = batch["observation"].squeeze(-1).tolist(), batch["begins"].tolist()
    advantages, targets = [], []
    for n, row in enumerate(begins):
        starts = [t for t, begun in enumerate(row) if begun]
        later, estimated = {}, []
        for t in reversed(starts):
            gain, steps, last = 0.0, 0, t
            for last in range(t, len(row)):
                gain += gamma**steps * (1 - gamma) * flat["reward"][n][last]
                steps += 1
                if flat["done"][n][last] or (last + 1 < len(row) and row[last + 1]):
                    break
            follows = not flat["done"][n][last] and last + 1 < len(row)
            future = 0.0 if flat["terminated"][n][last] else flat["observation"][n][last]
            delta = gain + gamma**steps * future - values[n][t]
            later[t] = delta + (gamma**steps * lmbda * later[last + 1] if follows else 0.0)
            estimated.insert(0, later[t])
        advantages += estimated
        targets += [advantage + values[n][t] for advantage, t in zip(estimated, starts, strict=True)]
    return advantages, targets


def normalised(numbers, clip):
    centre, spread = mean(numbers), max(stdev(numbers), 1e-8)
    return [min(max((number - centre) / spread, -clip), clip) for number in numbers]


numbers = st.floats(-2, 2, width=32)
steps = st.tuples(numbers, numbers, st.sampled_from([GOES_ON] * 6 + [TERMINATED, TRUNCATED]), st.booleans())


@given(
    rows=st.integers(2, 9).flatmap(lambda t: st.lists(st.lists(steps, min_size=t, max_size=t), min_size=1, max_size=3)),
    gamma=st.sampled_from([0.5, 0.9, 0.99]),
    lmbda=st.sampled_from([0.0, 0.7, 1.0]),
)
def test_they_follow_the_definition(rows, gamma, lmbda):
    rewards, values, outcomes, begins = ([[step[i] for step in row] for row in rows] for i in range(4))
    for row, ends in zip(begins, outcomes, strict=True):
        # An episode begins with a choice; what an earlier batch has chosen may go on at the beginning of the batch.
        row[1:] = [begun or end != GOES_ON for begun, end in zip(row[1:], ends, strict=False)]
    begins[0][-1] = True
    batch = trajectories(rewards, [[*row, 0.5] for row in values], outcomes, begins)
    advantages, targets = estimates(batch, gamma, lmbda)
    choices = SemiMarkovAdvantages(critic(), gamma=gamma, lmbda=lmbda, clip=4.0)(batch)
    torch.testing.assert_close(choices["value_target"].squeeze(-1), torch.tensor(targets), atol=1e-4, rtol=1e-4)
    if pstdev(advantages) > 1e-3:
        expected = torch.tensor(normalised(advantages, clip=4.0))
        torch.testing.assert_close(choices["advantage"].squeeze(-1), expected, atol=2e-3, rtol=2e-3)


# Two choices of two steps in one row, gamma 0.5: rewards 4 and 8, then 16 and 32, scaled by 1 - gamma to 2, 4, 8, 16.
# The values of the states are 1, -, 3, -, and that of the last next state is 5 (15 if it was cut off).
@pytest.mark.parametrize(
    ("outcomes", "targets"),
    [
        # The second: 8 + 16/2 + 5/4 = 17.25; the first: 2 + 4/2 + (3 + 0.5 (17.25 - 3)) / 4 = 6.53125.
        ([GOES_ON] * 4, [6.53125, 17.25]),
        # Without a future beyond the end: 8 + 16/2 = 16, and 2 + 4/2 + (3 + 0.5 * 13) / 4 = 6.375.
        ([GOES_ON, GOES_ON, GOES_ON, TERMINATED], [6.375, 16.0]),
        # The state that was cut off counts: 8 + 16/2 + 15/4 = 19.75, and 4 + (3 + 0.5 * 16.75) / 4 = 6.84375.
        ([GOES_ON, GOES_ON, GOES_ON, TRUNCATED], [6.84375, 19.75]),
        # The first choice ends with its episode: 2 + 4/2.
        ([GOES_ON, TERMINATED, GOES_ON, GOES_ON], [4.0, 17.25]),
        # And here by a time limit, in a state of value 10 + 3: 2 + 4/2 + 13/4.
        ([GOES_ON, TRUNCATED, GOES_ON, GOES_ON], [7.25, 17.25]),
    ],
    ids=["end of the batch", "termination", "time limit", "termination before", "time limit before"],
)
def test_targets_worked_out_by_hand(outcomes, targets):
    batch = trajectories(
        [[4.0, 8.0, 16.0, 32.0]], [[1.0, 9.0, 3.0, 9.0, 5.0]], [outcomes], [[True, False, True, False]]
    )
    choices = SemiMarkovAdvantages(critic(), gamma=0.5, lmbda=0.5, clip=4.0)(batch)
    assert choices["value_target"].squeeze(-1).tolist() == pytest.approx(targets)


def test_an_early_end_discounts_by_the_steps_that_were_taken_and_not_by_those_that_were_planned():
    batch = trajectories([[1.0] * 3], [[0.0] * 4], [[TRUNCATED, GOES_ON, GOES_ON]], [[True, True, False]])
    choices = SemiMarkovAdvantages(critic(), gamma=0.5, lmbda=1.0, clip=4.0)(batch)
    # One step to a state of value 10, where two were planned; then two to the end of the batch, of value 0.
    assert choices["value_target"].squeeze(-1).tolist() == pytest.approx([0.5 + 0.5 * 10, 0.5 + 0.25])


def test_choices_of_one_step_are_ordinary_advantages():
    generator = torch.Generator().manual_seed(0)
    rewards, values = torch.randn(3, 8, generator=generator), torch.randn(3, 9, generator=generator)
    outcomes = torch.randint(0, 12, (3, 8), generator=generator)
    outcomes = outcomes.where(outcomes <= TRUNCATED, GOES_ON)
    batch = trajectories(rewards.tolist(), values.tolist(), outcomes.tolist(), [[True] * 8] * 3)
    settings = {"gamma": 0.9, "lmbda": 0.8, "clip": 100.0}
    choices = SemiMarkovAdvantages(critic(), **settings)(batch.clone())
    expected = Advantages(critic(), **settings)(batch).flatten()
    torch.testing.assert_close(choices["value_target"], expected["value_target"])
    torch.testing.assert_close(choices["advantage"], expected["advantage"], atol=1e-4, rtol=1e-4)


def test_only_choices_are_returned_and_the_state_values_are_seen_only_where_they_count():
    seen = []
    module = critic()
    module.register_forward_hook(lambda _, __, out: seen.append(out["state_value"].numel()))
    outcomes = [[GOES_ON, TRUNCATED, GOES_ON, GOES_ON, GOES_ON, GOES_ON]]
    begins = [[False, True, True, False, False, True]]
    batch = trajectories([[1.0] * 6], [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]], outcomes, begins)
    choices = SemiMarkovAdvantages(module, gamma=0.9, lmbda=0.9, clip=4.0)(batch)
    assert choices["observation"].flatten().tolist() == [1.0, 2.0, 5.0]
    assert sum(seen) == 3 + 2


def test_a_single_choice_has_no_advantage_over_others():
    batch = trajectories([[1.0, 1.0]], [[0.0, 0.0, 0.0]], [[GOES_ON, GOES_ON]], [[True, False]])
    choices = SemiMarkovAdvantages(critic(), gamma=0.9, lmbda=0.9, clip=4.0)(batch)
    assert choices["advantage"].item() == 0.0


def test_a_batch_without_choices_is_refused():
    batch = trajectories([[1.0, 1.0]], [[0.0, 0.0, 0.0]], [[GOES_ON, GOES_ON]], [[False, False]])
    advantages = SemiMarkovAdvantages(critic(), gamma=0.9, lmbda=0.9, clip=4.0)
    refused(lambda: advantages(batch), "training.frames_per_batch", "batch_factor", "training.num_envs")
    refused(lambda: advantages(batch.exclude("begins")), "begins")


def two_choices_in_each_of_four_rows():
    generator = torch.Generator().manual_seed(0)
    rewards, values = torch.randn(4, 3, generator=generator), torch.randn(4, 4, generator=generator)
    outcomes = [[GOES_ON, TERMINATED, GOES_ON], [GOES_ON, TRUNCATED, GOES_ON]] * 2
    return trajectories(rewards.tolist(), values.tolist(), outcomes, [[True, False, True]] * 4)


def test_trajectories_may_have_any_batch_dimensions():
    batch = two_choices_in_each_of_four_rows()
    estimate = SemiMarkovAdvantages(critic(), gamma=0.9, lmbda=0.8, clip=4.0)
    expected = estimate(batch)["value_target"]
    torch.testing.assert_close(estimate(batch.reshape(2, 2, 3))["value_target"], expected)
    torch.testing.assert_close(estimate(batch[1])["value_target"], expected[2:4])


def test_rewards_or_a_default_in_float64_change_nothing():
    batch = two_choices_in_each_of_four_rows()
    estimate = SemiMarkovAdvantages(critic(), gamma=0.9, lmbda=0.8, clip=4.0)
    expected = estimate(batch)["value_target"]
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(estimate(batch)["value_target"], expected)
    finally:
        torch.set_default_dtype(torch.float32)
    batch["next", "reward"] = batch["next", "reward"].double()
    torch.testing.assert_close(estimate(batch)["value_target"], expected)
