import math
from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal

from torchrl_mcp.adapters.contract import Reach
from torchrl_mcp.envs import Holdout
from torchrl_mcp.evaluation.rollout import Evaluation, episode_statistics, evaluate


class Countdown(EnvBase):
    """Environment n pays ``n + 1`` per step for ``lengths[n]`` steps, walking along x.

    Episodes are terminated, save the first one of odd environments, which is truncated.
    """

    batch_locked = True

    def __init__(self, lengths):
        super().__init__(batch_size=[len(lengths)])
        self.lengths, self.elapsed = torch.tensor(lengths), torch.zeros(len(lengths), dtype=torch.int64)
        self.truncates = torch.arange(len(lengths)) % 2 == 1
        shape, one = self.batch_size, (*self.batch_size, 1)
        self.observation_spec = Composite(observation=Unbounded(one), goal=Unbounded(one), shape=shape)
        self.action_spec, self.reward_spec = Unbounded(one), Unbounded(one)
        done = {key: Binary(1, shape=one, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(done, shape=shape)

    def get_state(self):
        x = self.elapsed.double()
        return TensorDict(qpos=torch.stack([x, -x, torch.ones_like(x)], -1), batch_size=self.batch_size)

    def _emit(self, done, **kwargs):
        flags = {"done": done, "terminated": done & ~self.truncates, "truncated": done & self.truncates}
        flags = {key: value.unsqueeze(-1) for key, value in flags.items()}
        x = self.elapsed.float().unsqueeze(-1)
        return TensorDict(observation=x, goal=x, **flags, **kwargs, batch_size=self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            self.truncates[mask.squeeze(-1)] = False
        self.elapsed[slice(None) if mask is None else mask.squeeze(-1)] = 0
        return self._emit(torch.zeros_like(self.lengths, dtype=torch.bool))

    def _step(self, tensordict):
        self.elapsed += 1
        pay = torch.arange(1.0, 1.0 + len(self.lengths)).unsqueeze(-1)
        return self._emit(self.elapsed >= self.lengths, reward=pay)

    def _set_seed(self, seed):
        """Nothing is random."""


IDLE = TensorDictModule(lambda observation, goal: torch.zeros_like(observation), ["observation", "goal"], ["action"])


def gaussian_policy():
    """A random network for the ant that stumbles about."""
    torch.manual_seed(0)

    class Network(nn.Linear):
        def forward(self, observation, goal):
            loc = super().forward(torch.cat([observation, goal], -1)).tanh()
            return loc, torch.full_like(loc, 0.3)

    head = ProbabilisticTensorDictModule(
        in_keys=["loc", "scale"], out_keys=["action"], distribution_class=IndependentNormal
    )
    network = TensorDictModule(Network(29, 8), ["observation", "goal"], ["loc", "scale"])
    return ProbabilisticTensorDictSequential(network, head)


def ants(**kwargs):
    return Holdout(
        num_envs=6, directions=(0.0, 1.5 * math.pi), **{"seed": 0, "num_threads": 1, "max_episode_steps": 40, **kwargs}
    )


def test_every_environment_gives_exactly_one_episode_however_short():
    outcome = evaluate(IDLE, Countdown([9, 2, 1, 4]))
    assert outcome.lengths.tolist() == [9, 2, 1, 4]
    assert outcome.returns.tolist() == [9 * 1, 2 * 2, 1 * 3, 4 * 4]
    assert outcome.terminated.tolist() == [True, False, True, False]


def test_positions_are_recorded_until_an_episode_ends_and_are_nan_from_there():
    env = Countdown([2, 4])
    positions = evaluate(IDLE, env, positions=lambda: env.get_state()["qpos"][:, :2]).positions
    assert positions.shape == (4, 2, 2)
    nan = math.nan
    short, long = [1.0, nan, nan, nan], [1.0, 2.0, 3.0, nan]
    expected = torch.tensor([short, long], dtype=torch.float64).T
    torch.testing.assert_close(positions[..., 0], expected, equal_nan=True)
    torch.testing.assert_close(positions[..., 1], -expected, equal_nan=True)


def test_returns_are_those_of_a_loop_by_hand():
    # Ants that soon leave a narrow range of heights: some episodes end early and at different times.
    narrow = {"healthy_z_range": (0.45, 0.95)}
    policy = gaussian_policy()
    outcome = evaluate(policy, ants(**narrow))

    env = ants(**narrow)
    state = env.reset()
    returns, lengths, over, early = [0.0] * 6, [0] * 6, [False] * 6, [False] * 6
    for _ in range(40):
        with torch.no_grad():
            action = policy[0](state.select("observation", "goal"))["loc"]
        state = env.step(state.select("observation", "goal").set("action", action))["next"]
        for n in range(6):
            if not over[n]:
                returns[n] += state["reward"][n].item()
                lengths[n] += 1
                over[n] = state["done"][n].item()
                early[n] = state["terminated"][n].item()
    assert all(over)
    assert len(set(lengths)) > 2
    torch.testing.assert_close(outcome.returns, torch.tensor(returns))
    assert outcome.lengths.tolist() == lengths
    assert outcome.terminated.tolist() == early


def test_the_deterministic_evaluation_repeats_to_the_bit_and_the_stochastic_one_does_not():
    policy = gaussian_policy()
    first, second = (evaluate(policy, env, positions=env.root_positions) for env in (ants(), ants()))
    assert torch.equal(first.returns, second.returns)
    assert torch.equal(first.positions.nan_to_num(), second.positions.nan_to_num())
    first, second = (evaluate(policy, ants(), deterministic=False) for _ in range(2))
    assert not torch.equal(first.returns, second.returns)
    first, second = (evaluate(policy, ants(seed=seed)) for seed in (0, 1))
    assert not torch.equal(first.returns, second.returns)


def episodes(returns, lengths=None, terminated=None):
    returns = torch.as_tensor(returns)
    return Evaluation(
        returns,
        torch.full(returns.shape, 10) if lengths is None else torch.tensor(lengths),
        torch.zeros(returns.shape, dtype=torch.bool) if terminated is None else torch.tensor(terminated),
    )


class Measured(Countdown):
    """Raises a flag in the second step of every episode, and counts the steps up and down."""

    metric_names: ClassVar = {"success": ["success"], "steps": ["up", "down"]}

    def __init__(self, lengths):
        super().__init__(lengths)
        one = (*self.batch_size, 1)
        self.observation_spec["success"] = Binary(1, shape=one, dtype=torch.bool)
        self.observation_spec["steps"] = Unbounded((*self.batch_size, 2))

    def _emit(self, done, **kwargs):
        elapsed = self.elapsed.unsqueeze(-1)
        steps = torch.cat([elapsed, -elapsed], -1).float()
        return super()._emit(done, success=elapsed == 2, steps=steps, **kwargs)


class Lasting(Measured):
    """The same, but the flag stays raised."""

    def _emit(self, done, **kwargs):
        return super()._emit(done, **kwargs).set("success", self.elapsed.unsqueeze(-1) >= 2)


def test_the_duration_of_a_flag_is_counted_in_steps_of_the_episode():
    assert evaluate(IDLE, Measured([1, 2, 5])).durations["success"].tolist() == [0, 1, 1]
    outcome = evaluate(IDLE, Lasting([1, 2, 5]))
    assert outcome.durations["success"].tolist() == [0, 1, 4]
    assert episode_statistics(outcome, lambda returns: returns)["durations"] == pytest.approx({"success": 5 / 3})


def test_a_success_pays_one_except_in_the_step_that_ends_the_episode():
    outcome = evaluate(IDLE, Lasting([1, 2, 5]))
    assert outcome.returns.tolist() == [1, 4, 15]
    # One step without success; then a truncated step with success; then three steps, and a terminated step that pays 3.
    assert outcome.success_returns.tolist() == [1, 2 + 1, 3 + 3 * 1 + 3]
    assert episode_statistics(outcome, lambda returns: returns / 5)["success_return"] == pytest.approx(13 / 15)
    assert evaluate(IDLE, Countdown([1])).success_returns is None
    assert "success_return" not in episode_statistics(episodes([1.0]), lambda returns: returns)


def test_flags_count_once_raised_and_numbers_are_averaged_over_the_episode():
    outcome = evaluate(IDLE, Measured([1, 2, 5]))
    assert outcome.metrics["success"].tolist() == [False, True, True]
    assert outcome.metrics["up"].tolist() == [1.0, 1.5, 3.0]
    expected = {"success": 2 / 3, "up": 5.5 / 3, "down": -5.5 / 3}
    assert episode_statistics(outcome, lambda returns: returns)["metrics"] == pytest.approx(expected)


def test_what_the_policy_wrote_in_every_step_of_every_episode_is_recorded():
    writer = TensorDictModule(
        lambda observation, goal: (torch.zeros_like(observation), observation.squeeze(-1)),
        ["observation", "goal"],
        ["action", "seen"],
    )
    decisions = evaluate(writer, Countdown([1, 3]), record=["seen"]).decisions
    assert sorted(decisions["seen"].tolist()) == [0, 0, 1, 2]  # steps before each: of the first, none; of the second
    assert "action" not in decisions.keys()  # noqa: SIM118


def test_the_statistics_of_four_episodes_by_hand():
    outcome = episodes([0.0, 2.0, 4.0, 6.0], [1, 2, 3, 10], [True, False, False, False])
    numbers = episode_statistics(outcome, lambda returns: returns / 10)
    low, high = numbers.pop("interval")
    assert 0 <= low < 0.3 < high <= 0.6
    assert numbers.pop("metrics") == numbers.pop("durations") == {}
    assert numbers == pytest.approx(
        {
            "normalised_return": 0.3,
            "normalised_return_std": math.sqrt((9 + 1 + 1 + 9) / 3) / 10,
            "return": 3.0,
            "length": 4.0,
            "terminated": 0.25,
            "episodes": 4,
        }
    )


def test_the_skill_of_returns_lies_between_those_of_standing_still_and_an_ideal_player():
    outcome = replace(
        episodes([1.0, 2.0], [1, 2], [True, False]), reach=Reach(torch.tensor([0.0, 1.0]), torch.tensor([4.0, 3.0]))
    )
    numbers = episode_statistics(outcome, lambda returns: returns / 10)
    assert numbers["reach"] == pytest.approx({"skill": (1.5 - 0.5) / (3.5 - 0.5), "standing": 0.05, "ideal": 0.35})


def test_an_ant_that_does_nothing_is_where_standing_still_is():
    idle = TensorDictModule(lambda state, goal: state.new_zeros(len(state), 8), ["observation", "goal"], ["action"])
    env = ants(reset_noise_scale=0.0, max_episode_steps=200)
    numbers = episode_statistics(evaluate(idle, env), env.normalised_return)
    assert numbers["reach"]["standing"] == pytest.approx(1 / 6)
    assert numbers["reach"]["ideal"] == 1
    assert numbers["reach"]["skill"] == pytest.approx(0, abs=0.03)


def test_the_interval_is_that_of_normal_theory_for_many_episodes():
    returns = 5 + 2 * torch.randn(400, generator=torch.Generator().manual_seed(0))
    low, high = episode_statistics(episodes(returns), lambda x: x)["interval"]
    half = 1.96 * returns.std().item() / math.sqrt(400)
    # Of 9999 resamples the 2.5 % quantile has a standard error of about 0.027 standard errors of the mean.
    assert low == pytest.approx(returns.mean().item() - half, abs=0.08 * half)
    assert high == pytest.approx(returns.mean().item() + half, abs=0.08 * half)


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    generator = torch.Generator().manual_seed(0)
    covered = 0
    for _ in range(200):
        low, high = episode_statistics(episodes(torch.randn(64, generator=generator)), lambda x: x)["interval"]
        covered += low <= 0 <= high
    # 95 % of 200 is 190, with a standard deviation of 3
    assert 180 <= covered <= 199


def test_the_statistics_repeat_and_leave_the_global_generator_alone():
    outcome = episodes(torch.randn(20))
    state = torch.get_rng_state()
    assert episode_statistics(outcome, lambda x: x) == episode_statistics(outcome, lambda x: x)
    assert torch.equal(torch.get_rng_state(), state)


def test_equal_episodes_have_an_interval_without_width():
    assert episode_statistics(episodes([3.0] * 10), lambda x: x)["interval"] == [3.0, 3.0]


def test_a_single_episode_has_no_spread():
    numbers = episode_statistics(episodes([3.0]), lambda x: x)
    assert (numbers["normalised_return"], numbers["normalised_return_std"]) == (3.0, 0.0)
    assert numbers["interval"] == [3.0, 3.0]


class Lucky(Countdown):
    """Raises a flag in every step of every episode but the first."""

    metric_names: ClassVar = {"success": ["success"]}

    def __init__(self, lengths):
        super().__init__(lengths)
        self.begun = torch.zeros(len(lengths), 1, dtype=torch.int64)
        self.observation_spec["success"] = Binary(1, shape=(*self.batch_size, 1), dtype=torch.bool)

    def _emit(self, done, **kwargs):
        return super()._emit(done, success=self.begun > 1, **kwargs)

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.begun += 1 if mask is None else mask
        return super()._reset(tensordict, **kwargs)


def test_flags_of_later_episodes_do_not_count():
    assert not evaluate(IDLE, Lucky([1, 2, 5])).metrics["success"].any()
