"""Isaac Lab's wrapper, around a stand-in that resets its environments itself, as the example of the guide makes it."""

import importlib

import pytest
import torch
from isaac import LIMIT, install
from points import play
from tensordict.nn import TensorDictModule

from torchrl_mcp.adapters.adapter import Adapter
from torchrl_mcp.adapters.check import require_contract, require_specs
from torchrl_mcp.objectives import Advantages

PLACE, STEPS = 9, 10
"""Entries of the observation: the place of the point, and the number of steps in the episode."""


@pytest.fixture
def env(monkeypatch, request):
    """Environments as the guide's file makes them."""
    install(monkeypatch)
    monkeypatch.syspath_prepend(request.config.rootpath / "docs" / "guide")
    env = Adapter(
        importlib.import_module("anymal").make(getattr(request, "param", 3), seed=0, device="cpu"),
        action_bounds=[-1, 1],
    )
    yield env
    env.close()


@pytest.fixture
def outcome(env):
    """Twelve steps: the second environment falls in every third step, the others stand until the time limit."""
    actions = torch.zeros(2 * LIMIT, 3, 2)
    actions[:, 1, 0] = 0.9
    return play(env, actions)


def test_the_wrapped_simulator_satisfies_the_contract(env):
    assert env.max_episode_steps == LIMIT
    assert env.observation_spec["observation"].shape == (3, 15)
    require_contract(env)
    require_specs(env)


def test_a_fall_is_terminated_and_a_time_out_is_truncated(outcome):
    terminated, truncated = (outcome["next", key].squeeze(-1) for key in ("terminated", "truncated"))
    assert terminated.tolist() == [[False] * 12, [False, False, True] * 4, [False] * 12]
    assert truncated[0].tolist() == truncated[2].tolist() == [*[False] * 5, True] * 2
    assert not (truncated[1] & ~terminated[1]).any()


def test_an_environment_begins_a_new_episode_alone(outcome):
    steps = outcome["observation"][..., STEPS]
    assert steps[0].tolist() == steps[2].tolist() == [0, 1, 2, 3, 4, 5] * 2
    assert steps[1].tolist() == [0, 1, 2] * 4
    numbers = outcome["observation"][..., 0]
    assert torch.equal(numbers, torch.tensor([[0.0], [1.0], [2.0]]).expand(3, 12))
    place, goal = outcome["observation"][..., PLACE], outcome["goal"][..., 0]
    for number, length in ((0, 6), (1, 3), (2, 6)):
        first = range(0, 12, length)
        assert len(set(place[number, first].tolist())) == len(first)
        assert torch.equal(goal[number], goal[number, first].repeat_interleave(length))
        torch.testing.assert_close(
            place[number], place[number, first].repeat_interleave(length) + 0.45 * (number == 1) * steps[number]
        )


def test_the_last_observation_is_the_one_before_the_last_step(outcome):
    done = outcome["next", "done"].squeeze(-1)
    assert done.sum() == 8
    for key in ("observation", "goal"):
        after = outcome["next", key]
        assert after.isfinite().all()
        assert torch.equal(after[done], outcome[key][done])
        assert torch.equal(after[:, :-1][~done[:, :-1]], outcome[key][:, 1:][~done[:, :-1]])


def test_a_time_out_is_bootstrapped_and_a_fall_is_not(outcome):
    critic = TensorDictModule(lambda seen: seen[..., STEPS : STEPS + 1] + 7.0, ["observation"], ["state_value"])
    target = Advantages(critic, gamma=0.9, lmbda=0.0, clip=4.0)(outcome)["value_target"].squeeze(-1)
    reward = 0.1 * outcome["next", "reward"].squeeze(-1)
    torch.testing.assert_close(target[0, 5], reward[0, 5] + 0.9 * (5 + 7))
    torch.testing.assert_close(target[0, 4], reward[0, 4] + 0.9 * (5 + 7))
    torch.testing.assert_close(target[1, 2], reward[1, 2])
    torch.testing.assert_close(target[1, 1], reward[1, 1] + 0.9 * (2 + 7))


@pytest.mark.parametrize("env", [1, 3], indirect=True)  # if all environments end, TorchRL resets them once more
def test_the_policy_sees_the_state_of_the_simulator_also_after_resets(env):
    state = env.reset()
    line = env._env.base_env._env
    actions = torch.tensor([[0.9], [0.0], [0.0]])[: env.num_envs].expand(env.num_envs, 2)
    falls = 0
    for _ in range(7):
        step, state = env.step_and_maybe_reset(state.set("action", actions))
        falls += int(step["next", "terminated"].sum())
        assert torch.equal(state["observation"][:, PLACE], line.x)
        assert torch.equal(state["observation"][:, STEPS], line.episode_length_buf.float())
    assert falls == 2
