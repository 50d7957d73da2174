import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from refusals import refused

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.gymnasium_env import GymnasiumEnv

NAMES = sorted(name for name in gymnasium.registry if name.startswith("torchrl_mcp/"))


def test_every_task_is_registered_with_every_character():
    tasks = ("Carry", "Dribble", "Heading", "Imitation", "Location")
    pairs = [(task, character) for task in tasks for character in CHARACTERS] + [("Holdout", "ant")]
    assert sorted(f"torchrl_mcp/{task}-{character.capitalize()}-v0" for task, character in pairs) == NAMES


def test_gymnasium_imports_the_environments_that_it_is_asked_for():
    code = """
import gymnasium
print(gymnasium.make("torchrl_mcp.envs:torchrl_mcp/Heading-Biped-v0").spec.id)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split()[-1].endswith("torchrl_mcp/Heading-Biped-v0")


@pytest.mark.parametrize("name", NAMES)
def test_a_specification_can_be_written_as_json_and_read_again(name):
    spec = gymnasium.spec(name)
    assert gymnasium.envs.registration.EnvSpec.from_json(spec.to_json()) == spec


def moves(env, number):
    """What an environment answers to random actions, through the ends of episodes."""
    answers = []
    for action in np.random.default_rng(1).uniform(-1, 1, (number, *env.action_space.shape)).astype(np.float32):
        observation, reward, terminated, truncated, _ = env.step(action)
        answers += [observation["observation"].copy(), reward, terminated, truncated]
        if terminated or truncated:
            answers.append(env.reset()[0]["goal"].copy())
    return answers


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("name", ["Heading-Biped", "Dribble-Trex", "Holdout-Ant", "Imitation-Trex"])
def test_a_copy_goes_on_as_the_original(name, copied):
    env = gymnasium.make(f"torchrl_mcp/{name}-v0", max_episode_steps=30)
    env.reset(seed=3)
    moves(env, 5)
    other = copied(env)
    assert other.spec == env.spec
    assert other.unwrapped.env is not env.unwrapped.env
    for one, two in zip(moves(env, 40), moves(other, 40), strict=True):
        np.testing.assert_array_equal(one, two)
    assert copied(gymnasium.make(f"torchrl_mcp/{name}-v0")).reset(seed=0)


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


def test_a_time_limit_longer_than_the_task_s_is_an_argument_of_the_task():
    env = GymnasiumEnv(Heading, character="biped", max_episode_steps=605, terminate_on_fall=False)
    env.reset(seed=0)
    truncated = [env.step(np.zeros(17))[3] for _ in range(605)]
    assert (sum(truncated), truncated[-1]) == (1, True)


def test_observations_of_double_precision_are_in_their_space():
    env = gymnasium.make("torchrl_mcp/Holdout-Ant-v0", dtype=torch.float64)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])


def test_an_unknown_render_mode_is_refused():
    refused(lambda: GymnasiumEnv(Heading, character="biped", render_mode="rgb"), "render_mode='rgb'", "rgb_array")


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
