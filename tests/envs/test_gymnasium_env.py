import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from torchrl_mcp.envs import Heading

NAMES = sorted(name for name in gymnasium.registry if name.startswith("torchrl_mcp/"))


def test_every_task_is_registered_with_every_character():
    tasks, characters = ("Carry", "Dribble", "Heading", "Imitation"), ("Biped", "Humanoid", "Trex")
    pairs = [(task, character) for task in tasks for character in characters] + [("Holdout", "Ant")]
    assert sorted(f"torchrl_mcp/{task}-{character}-v0" for task, character in pairs) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_finds_nothing_wrong(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*Box.*(minimum|maximum) value is (-)?infinity")
        check_env(gymnasium.make(name).unwrapped, skip_render_check=True)


@pytest.mark.parametrize(("name", "rate"), [("Holdout-Ant", 20), ("Heading-Biped", 30)])
def test_films_play_at_the_rate_of_control(name, rate):
    env = gymnasium.make(f"torchrl_mcp/{name}-v0")
    assert env.metadata["render_fps"] == rate
    assert env.unwrapped.env.control_timestep == pytest.approx(1 / rate)


def test_the_info_tells_success():
    env = gymnasium.make("torchrl_mcp/Dribble-Biped-v0")
    _, info = env.reset(seed=0)
    assert info == {"success": 0.0}
    assert env.step(env.action_space.sample())[-1].keys() == {"success"}


def test_a_single_environment_is_the_batch_of_one():
    env, batch = gymnasium.make("torchrl_mcp/Heading-Biped-v0", max_turn=0.1), Heading("biped", 1, max_turn=0.1, seed=3)
    state, (observation, _) = batch.reset(), env.reset(seed=3)
    for action in np.random.default_rng(0).uniform(-0.3, 0.3, (30, 17)).astype(np.float32):
        np.testing.assert_array_equal(observation["observation"], state["observation"][0])
        np.testing.assert_array_equal(observation["goal"], state["goal"][0])
        observation, reward, terminated, truncated, _ = env.step(action)
        state = batch.step(state.set("action", torch.tensor(action)[None]))["next"]
        assert (reward, terminated, truncated) == tuple(
            state[key].item() for key in ("reward", "terminated", "truncated")
        )
