"""Environments of Gymnasium as the adapter shows them, against Gymnasium's own."""

import gymnasium
import numpy as np
import pytest
import torch
from points import LENGTH, Point, play
from refusals import refused

from torchrl_mcp.adapters.check import require_specs
from torchrl_mcp.adapters.gym import FRAMES_PER_SECOND, GymnasiumEnvs


def test_each_environment_gives_gymnasiums_own_episodes_by_its_seed():
    actions = torch.rand(2 * LENGTH, 3, 1, generator=torch.Generator().manual_seed(0)) * 2 - 1
    env = GymnasiumEnvs("Point-v0", 3, seed=4, info=["is_success", "x"], observation=["observation", "achieved_goal"])
    outcome = play(env, actions)
    for number in range(3):
        own = gymnasium.make("Point-v0")
        own.reset(seed=4 + number)  # by the seed itself
        observed, _ = own.reset()  # the first episode
        for step, action in enumerate(actions[:, number]):
            shown = outcome[number, step]
            assert shown["goal"].tolist() == pytest.approx(observed["desired_goal"].tolist())
            observed, reward, _, truncated, info = own.step(2.0 * action.numpy())
            state = [*observed["observation"], *observed["achieved_goal"]]
            assert shown["next", "observation"].tolist() == pytest.approx(state)
            assert shown["next", "reward"].item() == pytest.approx(reward)
            assert shown["next", "is_success"].item() is bool(info["is_success"])
            assert shown["next", "x"].item() == pytest.approx(info["x"])
            assert not shown["next", "terminated"]
            assert shown["next", "truncated"].item() is truncated
            if truncated:
                observed, _ = own.reset()


def test_pendulum_earns_what_it_earns_in_gymnasium():
    env = GymnasiumEnvs("Pendulum-v1", 2, seed=0)
    assert env.max_episode_steps == 200
    require_specs(env)
    env.set_seed(0)
    outcome = play(env, torch.full((20, 2, 1), 0.5))
    own = gymnasium.make("Pendulum-v1")
    own.reset(seed=0)
    own.reset()
    rewards = [own.step(np.array([1.0]))[1] for _ in range(20)]
    assert outcome["next", "reward"][0].flatten().tolist() == pytest.approx(rewards, rel=1e-5)


def test_settings_reach_gymnasium_and_the_adapter():
    env = GymnasiumEnvs("Point-v0", 1, kwargs={"reach": 0.0}, max_episode_steps=3, goal=[], worst=-9, solved=0)
    assert env.max_episode_steps == 3
    assert env.control_timestep == pytest.approx(0.1)
    outcome = play(env, torch.ones(3, 1, 1))
    assert outcome["goal"].shape == (1, 3, 0)
    assert outcome["next", "reward"].flatten().tolist() == [-2.0, -4.0, -6.0]  # from a goal at 0
    assert outcome["next", "truncated"].flatten().tolist() == [False, False, True]
    assert env.metric_names == {}


def test_a_single_environment_draws_itself():
    env = GymnasiumEnvs("Point-v0", 1, seed=0)
    play(env, torch.zeros(3, 1, 1))
    picture = env.render()
    assert picture.shape == (8, 12, 3)
    assert picture.unique().tolist() == [3]
    refused(GymnasiumEnvs("Point-v0", 2).render, "Point-v0", "rgb_array", error=RuntimeError)


class SelfResetting(Point):
    """A point that begins anew in the step that ends its episode."""

    def step(self, action):
        observed, reward, terminated, truncated, info = super().step(action)
        if self.steps < 3:
            return observed, reward, terminated, truncated, info
        return self.reset()[0], reward, True, truncated, {"final_observation": observed}


gymnasium.register("SelfResetting-v0", entry_point=SelfResetting, max_episode_steps=9)


class Old(Point):
    """A point that needs another version of a library."""

    def __init__(self):
        assert gymnasium.__version__ == "0.1"


gymnasium.register("Old-v0", entry_point=Old, max_episode_steps=9)
gymnasium.register(
    "Autoreset-v0",
    entry_point=lambda: gymnasium.wrappers.Autoreset(Point()),
    max_episode_steps=9,
    disable_env_checker=True,
)


@pytest.mark.parametrize(
    ("id", "settings", "names"),
    [
        (None, {}, ["task.pretrain.id"]),
        ("Nowhere-v0", {}, ["id", "Nowhere"]),
        ("nowhere:Nowhere-v0", {}, ["id", "nowhere"]),
        ("Point-v0", {"kwargs": {"size": 3}}, ["id", "size"]),
        ("Old-v0", {}, ["id", "AssertionError", "test_gym.py"]),
        ("Point-v0", {"info": ["success"]}, ["info", "success", "is_success"]),
        ("CartPole-v1", {}, ["action", "discrete"]),
        ("Autoreset-v0", {}, ["id", "Autoreset"]),
        ("Point-v0", {"observation": ["state"]}, ["observation", "state", "achieved_goal"]),
    ],
)
def test_what_cannot_be_made_is_refused_with_the_reason(id, settings, names):
    refused(lambda: GymnasiumEnvs(id, 2, **settings), *names)


@pytest.mark.parametrize("rate", [0, None])
def test_without_a_frame_rate_a_step_takes_as_long_as_a_frame_of_a_film(rate, monkeypatch):
    monkeypatch.setattr(Point, "metadata", {"render_fps": rate})
    assert GymnasiumEnvs("Point-v0", 2).control_timestep == 1 / FRAMES_PER_SECOND


class Camera(Point):
    """A point that sees pictures alone."""

    def __init__(self):
        super().__init__()
        self.observation_space = gymnasium.spaces.Box(0, 255, (16, 16, 3), np.uint8)


def test_pictures_are_refused_because_they_need_an_encoder():
    gymnasium.register("Camera-v0", entry_point=Camera, max_episode_steps=9, disable_env_checker=True)
    refused(lambda: GymnasiumEnvs("Camera-v0", 2), "image", "(16, 16, 3)")


def test_an_environment_that_resets_itself_is_an_error_that_says_so():
    env = GymnasiumEnvs("SelfResetting-v0", 2, seed=0)
    refused(lambda: play(env, torch.zeros(4, 2, 1)), "SelfResetting-v0", "resets", error=ChildProcessError)


def test_the_number_of_the_goal_is_a_whole_number_for_each_environment():
    env = GymnasiumEnvs("Point-v0", 4, seed=0, goal_number="number")
    require_specs(env)
    assert env.num_goals == 7
    state = env.reset()
    places = (7 * (state["goal"].squeeze(-1) + 3.0) / 6.0).floor()  # seven places from -3 to 3
    assert state["goal_number"].tolist() == places.tolist()
    assert len(set(places.tolist())) > 1
    refused(lambda: GymnasiumEnvs("Point-v0", 4, goal_number="desired_goal"), "goal_number", "desired_goal", "number")
