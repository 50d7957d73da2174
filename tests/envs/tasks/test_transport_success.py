"""What carrying and dribbling earn: rewards, success and returns."""

import math

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from torchrl_mcp.envs import Carry, Dribble
from torchrl_mcp.evaluation.rollout import evaluate

every_task = pytest.mark.parametrize("task", [Carry, Dribble])


def make(task, character="biped", num_envs=4, **kwargs):
    return task(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def things(env, index):
    """Target and object of a simulation, as bodies of MuJoCo's."""
    data = env.simulation.data(index)
    return data.body("target"), data.body(env.simulation.model.nbody - 1)


def centre_of_mass(env, index):
    """Of the character, from the masses and places of its bodies."""
    masses = env.simulation.model.body_mass.copy()
    masses[env.simulation.model.body("target").id :] = 0
    return masses @ env.simulation.data(index).xipos / masses.sum()


@every_task
def test_velocities_in_the_reward_are_displacements_over_the_step(task):
    env = make(task, num_envs=1, dtype=torch.float64, terminate_on_fall=False)
    env.reset()
    state = env.get_state()
    state["qpos"][:, [2, -5]] += 3.0  # both in the air, where they fall freely
    state["qvel"][:, :2], state["qvel"][:, -6:-4] = torch.tensor([0.4, 0.3]), torch.tensor([-0.2, 0.6])
    carrier = env.reset(state, set_state=True)
    before = centre_of_mass(env, 0), things(env, 0)[1].xpos.copy()
    reward = env.step(carrier.set("action", torch.zeros(env.action_spec.shape)))["next", "reward"].item()
    target, thing = things(env, 0)
    com, place, goal = (x[:2] for x in (centre_of_mass(env, 0), thing.xpos, target.xpos))
    terms = []
    for now, then, aim, pace in ((com, before[0], place, 1.5), (place, before[1], goal, 1.0)):
        along = (now - then[:2]) * 30 @ (aim - now) / np.linalg.norm(aim - now)
        terms.append(math.exp(-pace * min(0.0, along - 1) ** 2))
    scale, weights = {Carry: (0.25, (0.1, 0.2, 0.3, 0.4)), Dribble: (0.5, (0.1, 0.1, 0.3, 0.5))}[task]
    near = math.exp(-scale * np.square(place - com).sum()), math.exp(-0.5 * np.square(goal - place).sum())
    expected = np.dot(weights, [terms[0], near[0], terms[1], near[1]])
    assert reward == pytest.approx(expected, rel=1e-9)


def near_success(env):
    """A state of two simulations, of which the first is a success and the second is not by some centimetres."""
    env.reset()
    state = env.get_state()
    away = {Dribble: [[0.0, 0.47], [0.0, 0.53]], Carry: [[0.0, 0.1], [0.0, 0.15]]}[type(env)]
    state["mocap_pos"][:, 0, :2] = state["qpos"][:, -7:-5] + torch.tensor(away)
    if "taken" in state:  # a box that was put down on the target
        state["taken"].fill_(1)
        state["mocap_pos"][:, 0, 2], state["mocap_pos"][:, 1, 0] = state["mocap_pos"][:, 1, 2], 9.0
        state["mocap_quat"][:, 0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    return state


@every_task
@pytest.mark.parametrize("success_reward", [False, True])
def test_success_has_a_limit_and_may_be_worth_one(task, success_reward):
    env = make(task, num_envs=2, object_distances=(1.0, 1.0), success_reward=success_reward)
    state = near_success(env)
    carrier = env.reset(state, set_state=True)
    assert carrier["success"].flatten().tolist() == [True, False]
    outcome = env.step(carrier.set("action", torch.zeros(2, 17)))["next"]
    assert outcome["success"].flatten().tolist() == [True, False]
    assert (outcome["reward"] == 1).flatten().tolist() == [success_reward, False]


@every_task
def test_an_evaluation_computes_the_return_with_a_success_reward(task):
    falling = TensorDictModule(lambda goal: torch.ones(2, 17), ["goal"], ["action"])
    outcomes = {}
    for success_reward in (False, True):
        env = make(task, num_envs=2, success_reward=success_reward, max_episode_steps=60, object_distances=(1.0, 1.0))
        outcomes[success_reward] = evaluate(falling, env, start=near_success(env))
    assert outcomes[False].terminated.any()
    assert outcomes[False].durations["success"][0] > 0
    assert not torch.allclose(outcomes[False].returns, outcomes[True].returns)
    for outcome in outcomes.values():
        torch.testing.assert_close(outcome.success_returns, outcomes[True].returns)


@every_task
def test_a_fallen_character_earns_nothing_from_success(task):
    env = make(task, num_envs=2, success_reward=True, object_distances=(1.0, 1.0))
    state = near_success(env)
    state["qpos"][:, 2], state["qpos"][:, 3:7] = 0.05, torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
    outcome = env.step(env.reset(state, set_state=True).set("action", torch.zeros(2, 17)))["next"]
    assert outcome["success"][0]
    assert outcome["terminated"].all()
    assert (outcome["reward"] == 0).all()


@every_task
def test_the_best_possible_return_is_one_and_the_worst_zero(task):
    env = make(task, num_envs=1, max_episode_steps=50)
    torch.testing.assert_close(env.normalised_return(torch.tensor([0.0, 25.0, 50.0])), torch.tensor([0.0, 0.5, 1.0]))
    assert make(task, num_envs=1).max_episode_steps == 3000
