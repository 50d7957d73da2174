"""Carrying and dribbling as environments: specs, seeds, resets, states and arguments."""

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from torchrl_mcp.envs import Carry, Dribble
from torchrl_mcp.envs.characters import CHARACTERS

every_task = pytest.mark.parametrize("task", [Carry, Dribble])
every_character = pytest.mark.parametrize("character", CHARACTERS)


def make(task, character="biped", num_envs=4, **kwargs):
    return task(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def actions(env, num_steps, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num_steps, *env.action_spec.shape, generator=generator) * 0.4 - 0.2


def play(env, carrier, script):
    """Step through ``script`` with partial resets; the stacked steps, and the last carrier."""
    steps = []
    for action in script:
        step, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        steps.append(step.select("observation", "goal", "success", "action", "next").clone())
    return torch.stack(steps), carrier


def assert_identical(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


@every_task
@every_character
def test_specs_describe_what_the_environment_does(task, character):
    env = make(task, character, 2)
    check_env_specs(env, seed=0)
    assert env.observation_spec["goal"].shape == (2, {Carry: 27, Dribble: 16}[task])


@every_task
@every_character
def test_the_same_seed_gives_the_same_trajectory_at_any_number_of_threads(task, character):
    runs = []
    for num_threads in (1, 2):
        env = make(task, character, num_threads=num_threads, max_episode_steps=8)
        runs.append(play(env, env.reset(), actions(env, 20))[0])
    assert runs[0]["next", "done"].sum() >= 8
    assert_identical(*runs)


@every_task
@every_character
def test_a_partial_reset_leaves_the_neighbours_alone(task, character):
    env = make(task, character)
    _, carrier = play(env, env.reset(), actions(env, 3))
    before = env.get_state()
    after = env.reset(carrier.set("_reset", torch.tensor([[False], [True], [False], [False]])))
    state, others = env.get_state(), [0, 2, 3]
    assert_identical(state[others], before[others])
    assert torch.equal(after["goal"][others], carrier["goal"][others])
    assert not torch.equal(state["mocap_pos"][1], before["mocap_pos"][1])
    assert not torch.equal(state["qpos"][1, -7:-5], before["qpos"][1, -7:-5])


@every_task
@every_character
def test_a_restored_environment_continues_bit_for_bit(task, character):
    env = make(task, character, max_episode_steps=12)
    script = actions(env, 24)
    _, carrier = play(env, env.reset(), script[:9])
    state, generator = env.get_state(), env.generator.get_state()
    onward, _ = play(env, carrier.clone(), script[9:])
    other = make(task, character, max_episode_steps=12, seed=9)
    play(other, other.reset(), script[:2])
    other.generator.set_state(generator)
    restored = other.reset(state, set_state=True)
    assert_identical(
        restored.select("observation", "goal", "success"), carrier.select("observation", "goal", "success")
    )
    again, _ = play(other, restored, script[9:])
    assert_identical(onward, again)


@every_task
@every_character
def test_a_diverging_simulation_ends_its_own_episode_only(task, character):
    env, calm = make(task, character), make(task, character)
    calm.reset()
    state, script = calm.get_state(), actions(calm, 1)
    expected, _ = play(calm, calm.reset(state.clone(), set_state=True), script)
    state["qvel"][2] = 1e8
    before = env.reset(state, set_state=True)
    goal = before["goal"].clone()
    steps, _ = play(env, before, script)
    assert steps["next", "terminated"].flatten().tolist() == [False, False, True, False]
    assert steps["next", "reward"][0, 2] == 0
    assert torch.equal(steps["next", "goal"][0, 2], goal[2])
    assert steps["next", "goal"].isfinite().all()
    assert_identical(steps[:, [0, 1, 3]], expected[:, [0, 1, 3]])


@every_task
def test_positions_and_velocities_alone_are_a_state(task):
    env = make(task)
    env.reset()
    whole = env.get_state()
    env.reset(whole.select("qpos", "qvel"), set_state=True)
    state = env.get_state()
    assert torch.equal(state["qpos"], whole["qpos"])
    assert not torch.equal(state["mocap_pos"], whole["mocap_pos"])
    assert torch.equal(state["object"], whole["qpos"][:, -7:-4])
