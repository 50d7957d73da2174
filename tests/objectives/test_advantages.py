from statistics import mean, stdev

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.value import GAE

from torchrl_mcp.objectives import Advantages, OptionAdvantages, SemiMarkovAdvantages

CONTINUES, TERMINATED, TRUNCATED, BOTH = range(4)


class Value(nn.Module):
    """A smooth function of state and goal that counts the states it has seen."""

    def __init__(self, scale=1.0):
        super().__init__()
        self.scale, self.seen = scale, 0

    def forward(self, observation, goal):
        self.seen += observation[..., 0].numel()
        return self.scale * (observation.sin().sum(-1, keepdim=True) + (2 * goal).cos().sum(-1, keepdim=True))


def critic(scale=1.0):
    return TensorDictModule(Value(scale), in_keys=["observation", "goal"], out_keys=["state_value"])


def trajectories(outcomes, seed):
    """A batch ``(N, T)`` in which step t ended as ``outcomes[n][t]`` says, and every end is followed by a reset."""
    generator = torch.Generator().manual_seed(seed)
    outcomes = torch.tensor(outcomes)
    shape = tuple(outcomes.shape)
    state = {
        "observation": torch.randn(*shape, 3, generator=generator),
        "goal": torch.randn(*shape, 2, generator=generator),
    }
    following = {}
    for key, value in state.items():
        # The next state is the following sample, but an end's is its own: the following sample begins an episode.
        own = 3 * torch.randn(value.shape, generator=generator)
        shifted = torch.cat([value[:, 1:], own[:, -1:]], 1)
        following[key] = torch.where((outcomes == CONTINUES).unsqueeze(-1), shifted, own)
    terminated = (outcomes == TERMINATED) | (outcomes == BOTH)
    truncated = (outcomes == TRUNCATED) | (outcomes == BOTH)
    following |= {
        "reward": torch.randn(*shape, 1, generator=generator),
        "terminated": terminated.unsqueeze(-1),
        "truncated": truncated.unsqueeze(-1),
        "done": (terminated | truncated).unsqueeze(-1),
    }
    return TensorDict(state, batch_size=shape).set("next", TensorDict(following, batch_size=shape))


def recursion(batch, gamma, lmbda):
    """Advantages and value targets from the definition, in plain Python, with rewards scaled by 1 - gamma."""
    value = critic()(batch.select("observation", "goal"))["state_value"].squeeze(-1).tolist()
    next_value = critic()(batch["next"].select("observation", "goal"))["state_value"].squeeze(-1).tolist()
    flat = {key: batch["next", key].squeeze(-1).tolist() for key in ("reward", "terminated", "done")}
    advantages, targets = [], []
    for n in range(batch.shape[0]):
        advantage, row = 0.0, []
        for t in reversed(range(batch.shape[1])):
            future = 0.0 if flat["terminated"][n][t] else next_value[n][t]
            delta = (1 - gamma) * flat["reward"][n][t] + gamma * future - value[n][t]
            advantage = delta + (0.0 if flat["done"][n][t] else gamma * lmbda * advantage)
            row.insert(0, advantage)
        advantages.append(row)
        targets.append([a + v for a, v in zip(row, value[n], strict=True)])
    return advantages, targets


def normalised(rows, clip):
    """Zero mean and unit variance over all samples, then clipped."""
    numbers = [number for row in rows for number in row]
    centre, spread = mean(numbers), max(stdev(numbers), 1e-8)
    return [[min(max((number - centre) / spread, -clip), clip) for number in row] for row in rows]


outcome = st.sampled_from([CONTINUES] * 5 + [TERMINATED, TRUNCATED, BOTH])
tables = st.tuples(st.integers(1, 3), st.integers(2, 9)).flatmap(
    lambda shape: st.lists(
        st.lists(outcome, min_size=shape[1], max_size=shape[1]), min_size=shape[0], max_size=shape[0]
    )
)


@given(
    outcomes=tables,
    seed=st.integers(0, 2**31),
    gamma=st.sampled_from([0.0, 0.5, 0.95, 0.99]),
    lmbda=st.sampled_from([0.0, 0.5, 0.95, 1.0]),
    clip=st.sampled_from([0.5, 4.0]),
)
def test_they_follow_the_definition(outcomes, seed, gamma, lmbda, clip):
    batch = trajectories(outcomes, seed)
    advantages, targets = recursion(batch, gamma, lmbda)
    Advantages(critic(), gamma=gamma, lmbda=lmbda, clip=clip)(batch)
    expected = {"advantage": normalised(advantages, clip), "value_target": targets}
    for key, numbers in expected.items():
        torch.testing.assert_close(batch[key].squeeze(-1), torch.tensor(numbers), atol=2e-4, rtol=1e-4, msg=key)


def test_an_end_that_is_marked_by_done_alone_does_not_see_the_next_episode():
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES, CONTINUES]], seed=0)
    expected = Advantages(critic(), gamma=0.9, lmbda=0.8, clip=4.0)(batch.clone())["value_target"]
    batch["next", "truncated"] = torch.zeros_like(batch["next", "truncated"])
    found = Advantages(critic(), gamma=0.9, lmbda=0.8, clip=4.0)(batch)["value_target"]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("position", [2, 4], ids=["within the batch", "at its end"])
def test_a_time_limit_is_bootstrapped_from_the_state_it_cut_off_and_a_termination_is_not(position):
    outcomes = [[CONTINUES] * 5]
    outcomes[0][position] = TRUNCATED
    batch = trajectories(outcomes, seed=0)
    cut_off = critic()(batch["next"][:, position].select("observation", "goal"))["state_value"].item()
    reward = batch["next", "reward"][0, position].item()
    targets = {}
    for name in ("truncated", "terminated"):
        if name == "terminated":
            batch["next", "terminated"] = batch["next", "done"].clone()
            batch["next", "truncated"] = torch.zeros_like(batch["next", "done"])
        Advantages(critic(), gamma=0.9, lmbda=0.95, clip=4.0)(batch)
        targets[name] = batch["value_target"][0, position].item()
    assert targets["truncated"] == pytest.approx(0.1 * reward + 0.9 * cut_off, abs=1e-5)
    assert targets["terminated"] == pytest.approx(0.1 * reward, abs=1e-5)


def test_the_end_of_the_batch_is_bootstrapped_from_the_next_state():
    batch = trajectories([[CONTINUES] * 4], seed=0)
    value = critic()(batch["next"][:, -1].select("observation", "goal"))["state_value"].item()
    Advantages(critic(), gamma=0.9, lmbda=0.95, clip=4.0)(batch)
    expected = 0.1 * batch["next", "reward"][0, -1].item() + 0.9 * value
    assert batch["value_target"][0, -1].item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("gamma", "lmbda"), [(0.95, 0.95), (0.99, 0.9), (0.9, 0.0)])
def test_they_are_torchrl_s_up_to_scale(seed, gamma, lmbda):
    outcomes = torch.multinomial(
        torch.tensor([0.8, 0.07, 0.07, 0.06]), 6 * 40, replacement=True, generator=torch.Generator().manual_seed(seed)
    )
    batch = trajectories(outcomes.view(6, 40).tolist(), seed)
    # TorchRL's own: unscaled rewards, so the critic that agrees with ours is larger by 1 / (1 - gamma).
    reference = batch.clone()
    GAE(gamma=gamma, lmbda=lmbda, value_network=critic(1 / (1 - gamma)), average_gae=True)(reference)
    Advantages(critic(), gamma=gamma, lmbda=lmbda, clip=1e6)(batch)
    torch.testing.assert_close(batch["value_target"], (1 - gamma) * reference["value_target"], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(batch["advantage"], reference["advantage"], atol=1e-3, rtol=1e-3)


def test_a_constant_reward_of_one_is_worth_one_for_any_discount():
    batch = trajectories([[CONTINUES] * 600], seed=0)
    batch["next", "reward"] = torch.ones(1, 600, 1)
    for gamma in (0.0, 0.9, 0.95):
        Advantages(critic(), gamma=gamma, lmbda=1.0, clip=4.0)(batch)
        assert batch["value_target"][0, 0].item() == pytest.approx(1, abs=1e-4)


def test_advantages_have_zero_mean_and_unit_variance_until_clipped():
    batch = trajectories([[CONTINUES] * 300] * 4, seed=0)
    free = Advantages(critic(), gamma=0.95, lmbda=0.95, clip=1e6)(batch.clone())["advantage"]
    torch.testing.assert_close(free.mean(), torch.tensor(0.0), atol=1e-5, rtol=0)
    torch.testing.assert_close(free.std(), torch.tensor(1.0))
    clipped = Advantages(critic(), gamma=0.95, lmbda=0.95, clip=1.5)(batch.clone())["advantage"]
    assert free.abs().max() > 1.5
    assert torch.equal(clipped, free.clamp(-1.5, 1.5))


def test_a_batch_without_any_advantage_stays_finite():
    batch = trajectories([[TERMINATED] * 5] * 2, seed=0)
    batch["next", "reward"].zero_()
    silent = TensorDictModule(
        lambda observation, goal: observation[..., :1] * 0, ["observation", "goal"], ["state_value"]
    )
    Advantages(silent, gamma=0.95, lmbda=0.95, clip=4.0)(batch)
    assert batch["advantage"].eq(0).all()


def test_the_critic_sees_every_state_once():
    # 12 states of the batch, two time limits within it, and the last next state of each of two environments.
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES] * 2, [CONTINUES, TERMINATED, CONTINUES] * 2], seed=0)
    module = critic()
    Advantages(module, gamma=0.95, lmbda=0.95, clip=4.0)(batch)
    assert module.module.seen == 12 + 2 + 2


def test_the_data_and_the_critic_s_gradients_are_left_alone():
    linear = nn.Linear(5, 1)
    module = TensorDictModule(
        lambda observation, goal: linear(torch.cat([observation, goal], -1)), ["observation", "goal"], ["state_value"]
    )
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES, TERMINATED]] * 2, seed=0)
    before = batch.clone()
    Advantages(module, gamma=0.95, lmbda=0.95, clip=4.0)(batch)
    assert (batch.select(*before.keys(True, True)) == before).all()
    assert set(batch.keys()) - set(before.keys()) == {"advantage", "value_target"}
    assert not any(batch[key].requires_grad for key in ("advantage", "value_target"))


def test_in_autocast_the_estimates_stay_float32():
    linear = nn.Linear(5, 1)
    module = TensorDictModule(
        lambda observation, goal: linear(torch.cat([observation, goal], -1)), ["observation", "goal"], ["state_value"]
    )
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES, TERMINATED]] * 2, seed=0)
    with torch.autocast("cpu", torch.bfloat16):
        Advantages(module, gamma=0.95, lmbda=0.95, clip=4.0)(batch)
    assert all(batch[key].dtype == torch.float32 for key in ("advantage", "value_target"))


def test_autocast_changes_no_bit_of_the_estimates_for_given_values():
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES, TERMINATED] * 5] * 2, seed=0)
    expected = Advantages(critic(), gamma=0.95, lmbda=0.95, clip=4.0)(batch.clone())
    with torch.autocast("cpu", torch.bfloat16):
        found = Advantages(critic(), gamma=0.95, lmbda=0.95, clip=4.0)(batch)
    assert all(torch.equal(found[key], expected[key]) for key in ("advantage", "value_target"))


def test_rewards_in_float64_change_nothing():
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES, TERMINATED]] * 2, seed=0)
    expected = Advantages(critic(), gamma=0.95, lmbda=0.95, clip=4.0)(batch.clone())
    batch["next", "reward"] = batch["next", "reward"].double()
    found = Advantages(critic(), gamma=0.95, lmbda=0.95, clip=4.0)(batch)
    assert all(torch.equal(found[key], expected[key]) for key in ("advantage", "value_target"))


def option_advantages(critic, **kwargs):
    return OptionAdvantages(critic, epsilon=0.1, termination_cost=0.01, **kwargs)


@pytest.mark.parametrize("estimator", [Advantages, SemiMarkovAdvantages, option_advantages])
@pytest.mark.parametrize("gamma", [1.0, 1.5, -0.1])
def test_without_a_discount_no_reward_would_be_left_so_it_is_refused(estimator, gamma):
    refused(lambda: estimator(critic(), gamma=gamma, lmbda=0.9, clip=4.0), f"gamma={gamma}")


def test_trajectories_may_have_any_batch_dimensions():
    batch = trajectories([[CONTINUES, TRUNCATED, CONTINUES], [TERMINATED, CONTINUES, CONTINUES]] * 2, seed=0)
    estimate = Advantages(critic(), gamma=0.9, lmbda=0.8, clip=4.0)
    expected = estimate(batch.clone())
    found = estimate(batch.reshape(2, 2, 3).clone())  # workers, simulations, steps
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(found[key].flatten(0, 1), expected[key])
    single = estimate(batch[1].clone())["value_target"]
    torch.testing.assert_close(single, expected["value_target"][1])


def test_the_critic_s_own_keys_are_read_and_a_missing_truncation_is_an_end_without_termination():
    batch = trajectories([[CONTINUES, TRUNCATED, TERMINATED, CONTINUES]], seed=0)
    expected = Advantages(critic(), gamma=0.9, lmbda=0.8, clip=4.0)(batch.clone())["value_target"]
    renamed = batch.rename_key_("goal", "wish").exclude(("next", "truncated"))
    renamed["next"].rename_key_("goal", "wish")
    other = TensorDictModule(Value(), in_keys=["observation", "wish"], out_keys=["state_value"])
    found = Advantages(other, gamma=0.9, lmbda=0.8, clip=4.0)(renamed)["value_target"]
    torch.testing.assert_close(found, expected)
