"""Steering without a window: goals, pushes, pinned gates and new episodes."""

import math

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.envs import Carry, Dribble, Heading, Location
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.policies import restore
from torchrl_mcp.viewer.player import Player
from torchrl_mcp.viewer.steering import Steering

IDLE = TensorDictModule(lambda goal: torch.zeros(len(goal), 17), in_keys=["goal"], out_keys=["action"])


def idle(task, **settings):
    return Steering(Player(IDLE, task("biped", 1, seed=0, num_threads=1, **settings)))


def target(steering):
    """Where the arrow of heading points, in radians."""
    [(tail, tip)] = steering.player.env.arrows(0)
    return math.atan2(*(tip - tail)[1::-1])


@pytest.fixture
def walker():
    """The built-in biped, which imitates motions under eight gates."""
    _, agent, env = restore(builtin("mcp", "biped"), num_envs=1, seed=0)
    return Steering(Player(agent.actor.policy, env))


def test_a_direction_in_hand_is_the_goal_wanders_no_more_and_outlasts_an_episode():
    steering = idle(Heading, max_turn=0.15)
    steering.turn(math.pi / 2)
    for _ in range(5):
        steering.step()
        assert target(steering) == pytest.approx(math.pi / 2)
    steering.reset()
    steering.step()
    env = steering.player.env
    seen = env.heading()[0] + math.atan2(*steering.player.state["goal"][0].flip(0).tolist())
    assert float(seen) == pytest.approx(math.pi / 2, abs=1e-6)


def test_turns_add_up_and_stay_between_plus_and_minus_pi():
    steering = idle(Heading)
    for _ in range(3):
        steering.turn(math.pi / 2)
    assert steering.target_direction == pytest.approx(-math.pi / 2)


def test_after_release_all_the_direction_wanders_again():
    steering = idle(Heading, max_turn=0.15)
    steering.aim(1.0)
    steering.step()
    steering.release_all()
    steering.step()
    assert 0 < abs(target(steering) - 1.0) <= 0.15


@pytest.mark.trajectories
def test_the_humanoid_walks_where_it_is_steered():
    _, agent, env = restore(builtin("mcp", "humanoid", "heading"), num_envs=1, seed=0, curriculum=None)
    steering = Steering(Player(agent.actor.policy, env))
    for angle in (0.0, 90.0):
        steering.aim(math.radians(angle))
        places = []
        for _ in range(90):
            steering.step()
            assert not steering.player.began  # no fall
            places.append(steering.player.data.subtree_com[1, :2].copy())
        way = places[-1] - places[-31]
        assert np.linalg.norm(way) == pytest.approx(1.0, abs=0.15)  # metres in a second
        assert math.degrees(math.atan2(way[1], way[0])) == pytest.approx(angle, abs=15.0)


@pytest.mark.trajectories
def test_the_humanoid_that_goes_to_places_walks_at_the_speed_and_in_the_direction_of_keys_and_stands_after_a_stop():
    _, agent, env = restore(builtin("mcp", "humanoid", "location"), num_envs=1, seed=0, curriculum=None)
    steering = Steering(Player(agent.actor.policy, env))
    steering.stop()
    steering.aim(0.0)
    for ups, angle, speed in ((2, 0, 0.6), (2, 90, 0.9), (0, 0, 0.0)):  # measured: a quarter more than 0.5, less than 1
        for _ in range(ups):
            steering.up()
        steering.turn(math.radians(angle))
        steering.stop() if not ups else None
        places = []
        for _ in range(150):
            steering.step()
            assert not steering.player.began  # no fall
            places.append(steering.player.data.subtree_com[1, :2].copy())
        way = (places[-1] - places[-61]) / 2  # in a second
        assert np.linalg.norm(way) == pytest.approx(speed, abs=0.15 if ups else 0.02)
        assert not ups or math.degrees(math.atan2(way[1], way[0])) == pytest.approx(angle, abs=15.0)


@pytest.mark.parametrize("task", [Carry, Dribble])
def test_a_target_is_where_it_is_put(task):
    steering = idle(task)
    steering.put((1.5, -2.5, 0.0))
    steering.step()
    assert steering.player.data.body("target").xpos[:2].tolist() == [1.5, -2.5]
    goal, env = steering.player.state["goal"][0], steering.player.env
    away = goal[env.goal_layout["target.position"]][:2].numpy()  # in the frame of the character
    root, angle = env.simulation.data(0).xpos[1, :2], float(env.heading()[0])
    turned = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    np.testing.assert_allclose(root + turned @ away, [1.5, -2.5], atol=1e-5)


def test_a_click_sends_a_carrier_for_the_box_that_it_put_down():
    steering = idle(Carry)
    env = steering.player.env
    steering.put((1.5, -2.5))
    assert env.get_state()["mocap_pos"][0, 1].tolist() == env.simulation.data(0).body("source").xpos.tolist()
    env.episode["taken"][0] = 1
    box = env.simulation.data(0).body("box").xpos[:2].tolist()
    steering.put((0.5, 2.5))
    steering.step()
    assert env.episode["taken"][0] == 0
    assert env.simulation.data(0).body("source").xpos[:2].tolist() == pytest.approx(box)
    assert env.simulation.data(0).body("target").xpos[:2].tolist() == [0.5, 2.5]


def test_a_character_is_sent_to_a_place_and_stops_where_it_is():
    steering = idle(Location, target_intervals=(0.1, 0.1))
    env = steering.player.env
    steering.put((1.5, -2.5, 0.0))
    for _ in range(5):
        steering.step()  # the task would draw places
    assert env.episode["target"][0].tolist() == [1.5, -2.5]
    steering.stop()
    here = env.com[0, :2].tolist()
    steering.step()
    assert env.episode["target"][0].tolist() == here
    steering.release_all()
    steering.step()
    assert env.episode["target"][0].tolist() != here


def test_a_place_leads_a_character_that_is_steered_until_a_click_or_a_stop():
    steering = idle(Location, target_intervals=(0.1, 0.1))
    env = steering.player.env
    for command, way in (
        (lambda: steering.aim(math.pi / 2), (0.0, 1.5)),  # at the speed of the task, 1.5 s ahead
        (lambda: steering.up(-1), (0.0, 1.125)),
        (lambda: steering.turn(-math.pi / 2), (1.125, 0.0)),
    ):
        command()
        before = env.com[0, :2].clone()
        steering.step()
        assert (env.episode["target"][0] - before).tolist() == pytest.approx(way, abs=1e-6)
    steering.put((3.0, 4.0))
    steering.step()
    assert env.episode["target"][0].tolist() == [3.0, 4.0]
    for _ in range(4):
        steering.up(-1)
    here = env.com[0, :2].tolist()
    for _ in range(3):
        steering.step()
        assert env.episode["target"][0].tolist() == pytest.approx(here, abs=1e-6)


def test_a_speed_stays_in_the_range_of_the_task_and_changes_no_more():
    steering = idle(Heading, speed=(0.0, 1.5), speed_interval=0.03)
    for change, expected in ((10.0, 1.5), (-0.25, 1.25), (-10.0, 0.0)):
        steering.accelerate(change)
        for _ in range(3):
            steering.step()
            assert float(steering.player.state["goal"][0, 2]) == expected
    steering.up()
    assert steering.target_speed == 0.25
    steering.stop()
    assert steering.target_speed == 0.0


def test_a_user_who_sets_the_direction_or_the_speed_has_both_in_hand_until_letting_go():
    for command in (lambda steering: steering.turn(0.5), lambda steering: steering.up()):
        steering = idle(Heading, speed=(0.0, 1.5), speed_interval=0.03, max_turn=0.15)
        command(steering)
        goals = set()
        for _ in range(5):
            steering.step()
            goals.add((round(target(steering), 9), float(steering.player.state["goal"][0, 2])))
        assert len(goals) == 1
        steering.release_all()
        steering.step()
        now = round(target(steering), 9), float(steering.player.state["goal"][0, 2])
        assert all(new != old for new, old in zip(now, *goals, strict=True))


def test_with_a_goal_of_the_users_an_episode_has_no_time_limit():
    steering = idle(Heading, max_episode_steps=3, terminate_on_fall=False)
    steering.aim(0.0)
    began = [steering.step() or steering.player.began for _ in range(6)]
    assert not any(began)
    steering.release_all()
    began = [steering.step() or steering.player.began for _ in range(3)]
    assert began == [False, False, True]  # the task has the episode's full length from here on


def test_of_a_task_without_it_nothing_is_turned_or_put():
    steering, ball, walk = idle(Heading), idle(Dribble), idle(Location)
    assert (walk.has_direction, walk.has_speed, walk.has_place, walk.can_stop) == (True, True, True, True)
    assert (steering.has_direction, steering.has_speed, steering.has_place) == (True, False, False)
    assert (ball.has_direction, ball.has_place, ball.can_stop) == (False, True, False)
    steering.put((1.0, 1.0))
    steering.accelerate(1.0)
    ball.turn(1.0)
    ball.stop()
    ball.step()
    assert steering.place is steering.speed is ball.direction is ball.place is None


def momentum(player):
    """Of the whole character, in kg m/s: what a finite difference of its centre of mass says."""
    data, model = player.data, player.env.simulation.model
    mujoco.mj_subtreeVel(model, data)
    return model.body_subtreemass[1] * data.subtree_linvel[1]


@pytest.mark.parametrize("body", ["torso", "left_ankle"])
def test_a_push_changes_momentum_by_force_times_time(body):
    steering = idle(Heading)
    env = steering.player.env
    state = env.get_state()
    state["qpos"][:, 2] += 5.0  # in the air, where nothing else but its weight acts on it
    env.reset(state.select("qpos", "qvel"), set_state=True)
    forces, force = np.zeros((env.simulation.model.nbody, 6)), np.array([30.0, -20.0, 10.0])
    forces[env.simulation.model.body(body).id, :3] = force
    before = momentum(steering.player)
    steering.push(forces)
    for _ in range(3):
        steering.step()
    weight = env.simulation.model.body_subtreemass[1] * env.simulation.model.opt.gravity
    np.testing.assert_allclose(momentum(steering.player) - before, (force + weight) * 0.1, rtol=0.01)
    before = momentum(steering.player)
    steering.push(0 * forces)
    steering.step()
    np.testing.assert_allclose(momentum(steering.player) - before, weight / 30, rtol=0.01, atol=0.01)


def test_a_primitive_that_plays_alone_acts_as_it_does_by_itself(walker):
    _, agent, _ = restore(builtin("mcp", "biped"), num_envs=1, seed=0)
    walker.step()
    for primitive in (2, 7):
        walker.play_alone(primitive)
        state = walker.player.state.clone()
        walker.step()
        parts = agent.parts
        with torch.no_grad():
            loc, _ = parts["primitives"](parts["observation_normaliser"](state["observation"]))
        torch.testing.assert_close(walker.player.action, loc[:, primitive], atol=1e-5, rtol=0)


def test_one_pinned_gate_leaves_the_others_to_the_gate_and_comes_back_when_released(walker):
    _, agent, _ = restore(builtin("mcp", "biped"), num_envs=1, seed=0)

    def gates(state):
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return agent.actor.policy(state)["gates"][0].tolist()

    walker.step()
    walker.pin(3, 0.25)
    state = walker.player.state.clone()
    walker.step()
    expected = gates(state)
    assert walker.player.weights.values == pytest.approx([*expected[:3], 0.25, *expected[4:]])
    walker.release(3)
    state = walker.player.state.clone()
    walker.step()
    assert walker.player.weights.values == pytest.approx(gates(state))


def test_keys_let_one_primitive_after_another_act_alone_and_then_the_gate(walker):
    walker.step()
    shown = []
    for _ in range(9):
        walker.play_next_alone(1)
        shown.append([number for number, weight in walker.player.pinned.items() if weight])
    assert shown == [[0], [1], [2], [3], [4], [5], [6], [7], []]
    walker.play_next_alone(-1)
    assert walker.player.pinned[7] == 1.0


def test_a_policy_without_gates_has_none_to_pin():
    steering = idle(Heading)
    steering.step()
    steering.play_alone(0)
    steering.play_next_alone(1)
    steering.pin(0, 0.5)
    steering.step()
    assert steering.player.weights is None


def test_a_reset_begins_a_new_episode():
    steering = idle(Heading)
    for _ in range(3):
        steering.step()
    steering.reset()
    assert steering.player.began
    assert steering.player.data.time == 0.0


@pytest.mark.parametrize(("weight", "held"), [(1.7, 1.0), (-0.2, 0.0), (0.3, 0.3)])
def test_a_gate_is_held_within_its_range(walker, weight, held):
    walker.pin(2, weight)
    assert walker.player.pinned == {2: held}


def test_without_a_speed_up_goes_to_the_last_primitive_and_down_to_the_first(walker):
    for sign, alone in ((1, 7), (-1, 0)):
        walker.player.pinned = {}
        walker.step()
        walker.up(sign)
        assert walker.player.pinned == {number: float(number == alone) for number in range(8)}
