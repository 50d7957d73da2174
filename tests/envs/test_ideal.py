import math

import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading
from torchrl_mcp.envs.ideal import transport_reach
from torchrl_mcp.envs.tasks.rewards import transport_reward

LAWS = {
    "weights": Dribble.weights,
    "proximity_scale": Dribble.proximity_scale,
    "speed": 1.0,
    "target_distance_power": 2,
}


def reach(com, position, target, num_steps, **laws):
    places = (torch.tensor([place], dtype=torch.float64) for place in (com, position, target))
    found = transport_reach(
        lambda *state: transport_reward(*state, **{**LAWS, **laws}),
        *places,
        speed=1.0,
        timestep=0.1,
        num_steps=num_steps,
    )
    return [value.item() for value in found]


def test_who_stands_still_earns_the_reward_of_standing_in_every_step():
    standing, _ = reach([0.0, 0.0], [0.0, 1.0], [2.0, 1.0], 7)
    expected = 0.1 * math.exp(-1.5) + 0.1 * math.exp(-0.5) + 0.3 * math.exp(-1) + 0.5 * math.exp(-2)
    assert standing == pytest.approx(7 * expected)


def test_the_ideal_player_walks_to_the_object_then_with_it_and_waits_at_the_target():
    """One metre to the object and half a metre on, in steps of 10 cm: 10 to reach it, 5 to bring it, 5 to wait."""
    expected, com, thing = 0.0, 0.0, 1.0
    for step in range(1, 21):
        before = thing
        thing = min(1.5, 1.0 + 0.1 * max(0, step - 10))
        com_before, com = com, min(thing, 0.1 * step)
        missing, left = (com - com_before) / 0.1 - 1, thing - com
        forward = (thing - before) / 0.1 if thing < 1.5 else 0.0  # at the target, no direction leads there
        expected += 0.1 * math.exp(-1.5 * missing**2) + 0.1 * math.exp(-0.5 * left**2)
        expected += 0.3 * math.exp(-((forward - 1) ** 2)) + 0.5 * math.exp(-0.5 * (1.5 - thing) ** 2)
    assert reach([0.0, 0.0], [1.0, 0.0], [1.5, 0.0], 20)[1] == pytest.approx(expected, rel=2e-3)


def test_a_ball_that_is_moved_to_and_fro_at_its_target_earns_more_than_one_that_rests_there():
    """At 1 m/s, from 5 to 25 cm before the target, by a player who stands: the printed formula of four moments."""

    def earned(left, forward):
        still, near = 0.1 * math.exp(-1.5), 0.6 * math.exp(-0.5 * left**2)
        return still + near + 0.3 * math.exp(-(min(0.0, forward - 1) ** 2))

    moved = sum(earned(*moment) for moment in ((0.15, -1), (0.25, -1), (0.15, 1), (0.05, 1))) / 4
    resting = reach([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], 100)[1] / 100
    assert resting + 0.02 < moved < 1


def test_the_ideal_player_turns_with_the_object_to_wherever_the_target_is():
    straight = reach([0.0, 0.0], [1.0, 0.0], [3.0, 0.0], 60)[1]
    around = reach([0.0, 0.0], [1.0, 0.0], [1.0, -2.0], 60)[1]
    assert around == pytest.approx(straight, rel=0.02)


@pytest.mark.parametrize(("task", "low", "high"), [(Dribble, 0.55, 0.75), (Carry, 0.55, 0.75)])
def test_nobody_can_earn_all_of_the_printed_reward(task, low, high):
    env = task("biped", 64, seed=0, num_threads=1, max_episode_steps=900)
    env.reset()
    standing, ideal = (env.normalised_return(returns).mean() for returns in env.reach())
    assert 0.15 < standing < 0.25
    assert low < ideal < high


@pytest.mark.parametrize("task", [Dribble, Carry])
def test_who_does_nothing_and_does_not_fall_earns_what_standing_still_does(task):
    env = task("biped", 4, seed=0, num_threads=1, max_episode_steps=5, terminate_on_fall=False)
    state = env.reset()
    standing, returns = env.reach().standing, torch.zeros(4, 1)
    for _ in range(5):
        state = env.step(state.set("action", torch.zeros(env.action_spec.shape)))["next"]
        returns += state["reward"]
    torch.testing.assert_close(returns.squeeze(-1), standing.float(), rtol=0.05, atol=0.0)


def test_standing_far_from_a_ball_at_its_target_is_no_success():
    ranges = {"object_distances": (3, 5), "target_distances": (0, 0.4)}
    env = Dribble("biped", 4, seed=0, num_threads=1, max_episode_steps=5, success_reward=True, **ranges)
    state = env.reset()
    standing, returns = env.reach().standing, torch.zeros(4, 1)
    for _ in range(5):
        state = env.step(state.set("action", torch.zeros(env.action_spec.shape)))["next"]
        returns += state["reward"]
    torch.testing.assert_close(returns.squeeze(-1), standing.float(), rtol=0.05, atol=0.0)


def test_with_a_reward_for_success_the_ideal_is_higher_in_every_episode():
    reaches = []
    for success_reward in (False, True):
        env = Dribble("biped", 16, seed=0, num_threads=1, max_episode_steps=900, success_reward=success_reward)
        env.reset()
        reaches.append(env.reach().ideal)
    assert (reaches[1] >= reaches[0]).all()
    assert reaches[1].mean() > 1.15 * reaches[0].mean()


def test_heading_reaches_all_and_standing_next_to_nothing():
    env = Heading("biped", 3, seed=0, num_threads=1, max_episode_steps=50)
    env.reset()
    standing, ideal = env.reach()
    torch.testing.assert_close(standing, torch.full((3,), 50 * math.exp(-4), dtype=torch.float64))
    torch.testing.assert_close(ideal, torch.full((3,), 50.0, dtype=torch.float64))
