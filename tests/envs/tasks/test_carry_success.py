"""The end of carrying: where the joint opens, and what is a success."""

import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Carry

HALF_SIZE = 0.15  # of the box


@pytest.fixture
def over_the_target(holding):
    """Make states in which the box that is held is above the target."""

    def hold(env, clearance, shift=0.0):
        state = holding(env)
        state["mocap_pos"][:, 1, 0] += 5
        place = state["qpos"][:, -7:-4].clone()
        place[:, 2] -= HALF_SIZE + clearance
        place[:, 0] += shift
        state["mocap_pos"][:, 0] = place
        return state

    return hold


def make(num_envs=2, character="biped", **kwargs):
    return Carry(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def play(env, carrier, num_steps):
    for _ in range(num_steps):
        carrier = env.step(carrier.set("action", torch.zeros(env.action_spec.shape)))["next"]
    return carrier


def joined(env):
    return env.simulation.state["eq_active"].flatten().tolist()


def test_a_box_that_stands_on_the_target_when_the_joint_opens_earns_the_full_reward_in_training(over_the_target):
    weights = [1.0, 0.2, 1.0, 2.0]
    env = make(curriculum={"reward_weights": weights, "success_worth": 2})
    outcome = play(env, env.reset(over_the_target(env, 0.005), set_state=True), 1)
    full = sum(weights) - np.exp(-1.5) - np.exp(-1)
    assert outcome["success"].all()
    assert not outcome["terminated"].any()
    np.testing.assert_allclose(outcome["reward"], 2 * full, rtol=1e-6)


def test_the_reward_is_1_from_the_step_on_in_which_the_joint_opens_if_a_success_is_rewarded(over_the_target):
    env = make(success_reward=True)
    outcome = play(env, env.reset(over_the_target(env, 0.005), set_state=True), 1)
    assert outcome["success"].all()
    assert (outcome["reward"] == 1).all()


@pytest.mark.parametrize("clearance", [0.005, 0.1])
def test_the_joint_opens_over_the_target_and_the_box_then_stands_there(clearance, over_the_target):
    env = make()
    carrier = env.reset(over_the_target(env, clearance), set_state=True)
    carrier = play(env, carrier, 1)
    assert joined(env) == [0.0, 0.0]
    play(env, carrier, 20)
    data = env.simulation.data(0)
    assert data.body("box").xpos[2] - HALF_SIZE == pytest.approx(data.body("target").xpos[2], abs=2e-3)
    assert np.abs(data.body("box").cvel).max() < 1e-2


@pytest.mark.parametrize(("clearance", "shift"), [(0.13, 0.0), (0.005, 0.145)])
def test_the_joint_stays_closed_above_the_target_and_beside_it(clearance, shift, over_the_target):
    env = make()
    play(env, env.reset(over_the_target(env, clearance, shift), set_state=True), 3)
    assert joined(env) == [1.0, 1.0]


def test_success_is_a_box_that_was_taken_and_put_down_on_the_target(over_the_target):
    env = make(3)
    state = over_the_target(env, 0.0)
    state["eq_active"][1:] = 0
    state["taken"][2] = 0
    state["qpos"][:, 0] -= 1  # away from the box, which stands on the target: held, put down, and never taken
    carrier = env.reset(state, set_state=True)
    assert carrier["success"].flatten().tolist() == [False, True, False]
    beside = state.clone()
    beside["mocap_pos"][:, 0, 0] += 0.3
    assert not env.reset(beside, set_state=True)["success"].any()
    above = state.clone()
    above["mocap_pos"][:, 0, 2] -= 0.03
    assert not env.reset(above, set_state=True)["success"].any()


def test_no_episode_begins_with_a_success():
    env = make(500, object_distances=(0.5, 1.0), target_distances=(0.0, 0.5))
    assert not env.reset()["success"].any()


def test_a_box_that_was_put_down_is_not_taken_again_in_the_same_episode(over_the_target):
    env = make()
    play(env, env.reset(over_the_target(env, 0.005), set_state=True), 2)
    state = env.get_state()
    state["mocap_pos"] = state["mocap_pos"].flip(1)  # now the box stands on the source
    assert (env.simulation.outputs["sensordata"] < 0).all()
    play(env, env.reset(state, set_state=True), 3)
    assert joined(env) == [0.0, 0.0]
    state["taken"][1] = 0
    play(env, env.reset(state, set_state=True), 1)
    assert joined(env) == [0.0, 1.0]


def test_a_box_that_was_put_down_is_offered_on_the_source_and_taken_again(over_the_target):
    env = make(2)
    carrier = play(env, env.reset(over_the_target(env, 0.05), set_state=True), 20)
    assert carrier["success"].all()
    before = env.get_state()
    env.offer(0)
    state = env.get_state()
    assert (state[1] == before[1]).all()
    assert torch.equal(state["qpos"][0, :-5], before["qpos"][0, :-5])
    source = state["mocap_pos"][0, 1]
    torch.testing.assert_close(source[:2], before["qpos"][0, -7:-5])
    assert state["qpos"][0, -5] - source[2] == pytest.approx(HALF_SIZE)
    assert source[2] - state["mocap_pos"][0, 0, 2] > 0.0
    state["qpos"][0, -7] -= 0.01  # against the torso
    play(env, env.reset(state, set_state=True), 1)
    assert joined(env) == [1.0, 0.0]
    env.offer(0)  # in hand: nothing to offer
    assert joined(env) == [1.0, 0.0]
