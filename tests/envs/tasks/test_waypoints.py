"""Where a character should go next, and what a gate that goes to places does with it."""

import math

import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading, Location
from torchrl_mcp.envs.tasks.waypoints import carry_waypoint, dribble_waypoint

HERE = torch.zeros(1, 2)


def at(*place):
    return torch.tensor([place], dtype=torch.float32)


def yes(answer):
    return torch.tensor([answer])


@pytest.mark.parametrize(
    ("taken", "held", "target", "expected"),
    [
        (False, False, (2.0, 5.0), (2.0, 1.0)),  # to the box
        (True, True, (2.0, 5.0), (0.0, 1.0)),  # a metre of the box's way to the target
        (True, True, (2.0, 1.4), (0.0, 0.7)),  # the rest of it, and 0.3 m
        (True, False, (2.0, 1.0), (0.0, 0.0)),  # where the character stands
    ],
)
def test_the_way_of_a_carrier_leads_to_the_box_then_past_the_target_and_ends(taken, held, target, expected):
    place = carry_waypoint(HERE, at(2.0, 1.0), at(*target), yes(taken), yes(held))
    torch.testing.assert_close(place, at(*expected))


@pytest.mark.parametrize(
    ("ball", "expected"),
    [
        ((3.0, 0.0), (3.5, 0.0)),  # in front, the target beyond it: through the ball
        ((0.3, 3.0), (-0.2, 3.0)),  # to the left, the target far ahead: behind the ball
        ((-3.0, 0.1), (-3.5, -0.4)),  # between the ball and its target: around it on the side where the character is
        ((-3.0, -0.1), (-3.5, 0.4)),
    ],
)
def test_the_way_of_a_dribbler_leads_around_the_ball_and_through_it(ball, expected):
    far = at(1e6, 0.0)
    place = dribble_waypoint(HERE, at(*ball), at(*ball), far)
    torch.testing.assert_close(place, at(*expected), atol=1e-5, rtol=0)


def test_a_dribbler_meets_a_rolling_ball_halfway_and_pushes_it_slowly_near_its_target():
    place = dribble_waypoint(HERE, at(1.0, 0.0), at(3.0, 0.0), at(4.0, 0.0))
    torch.testing.assert_close(place, at(2.2, 0.0))  # a tenth of the two metres that are left beyond it


def test_a_dribbler_waits_for_a_ball_that_rolls_to_its_target():
    target = at(3.9, 0.0)
    for rest, waits in ((1.9, False), (3.3, False), (3.5, True), (4.3, True), (4.5, False)):
        place = dribble_waypoint(HERE, at(1.9, 0.0), at(rest, 0.0), target)
        assert torch.equal(place, HERE) == waits


def test_a_dribbler_goes_to_a_ball_at_its_target_until_it_is_near():
    for distance, place in ((2.1, at(2.1, 0.0)), (1.9, HERE)):
        ball = at(distance, 0.0)
        assert torch.equal(dribble_waypoint(HERE, ball, ball, ball + 0.1), place)


@pytest.mark.parametrize(("task", "thing"), [(Carry, "box"), (Dribble, "ball")])
def test_the_goal_ends_with_the_waypoint_as_the_location_task_shows_places(task, thing):
    env = task("biped", 3, seed=0, num_threads=1, waypoint=True, dtype=torch.float64)
    plain = task("biped", 3, seed=0, num_threads=1, dtype=torch.float64).reset()["goal"]
    goal = env.reset()["goal"]
    assert torch.equal(goal[:, :-2], plain)
    assert env.goal_layout["waypoint"] == slice(plain.shape[-1], goal.shape[-1])
    if task is Dribble:
        return
    for index in range(3):
        data = env.simulation.data(index)
        way = (data.body(thing).xpos - data.subtree_com[1])[:2]
        forward = data.body("root").xmat.reshape(3, 3)[:2, 0]
        angle = math.atan2(way[1], way[0]) - math.atan2(forward[1], forward[0])
        expected = math.log1p(np.linalg.norm(way) / 0.25) * np.array([math.cos(angle), math.sin(angle)])
        np.testing.assert_allclose(goal[index, -2:], expected, atol=1e-9)


@pytest.mark.parametrize("speed", [0.8, (0.0, 1.0)])
def test_the_goal_of_heading_ends_with_the_place_where_a_character_is_after_a_second_and_a_half(speed):
    env = Heading("biped", 4, seed=0, num_threads=1, speed=speed, waypoint=True, dtype=torch.float64)
    plain = Heading("biped", 4, seed=0, num_threads=1, speed=speed, dtype=torch.float64)
    goal, env.episode["speed"][0] = env.reset()["goal"], 0.0
    env.episode["direction"] += 0.5
    assert torch.equal(goal[:, :-2], plain.reset()["goal"])
    assert env.goal_layout["waypoint"] == slice(plain.reset()["goal"].shape[-1], goal.shape[-1])
    goal = env.observe(slice(None))["goal"]
    for index in range(4):
        length = math.log1p(1.5 * float(env.episode["speed"][index]) / 0.25)
        expected = length * np.array([math.cos(0.5), math.sin(0.5)])
        np.testing.assert_allclose(goal[index, -2:], expected, atol=1e-9)
    assert goal[:, -2:].any(-1).tolist() == [False, True, True, True]  # the first should stand where it is


def test_a_place_and_a_waypoint_have_the_same_size():
    location = Location("biped", 1, seed=0, num_threads=1).reset()["goal"]
    layout = Carry("biped", 1, seed=0, num_threads=1, waypoint=True).goal_layout
    assert location.shape[-1] == layout["waypoint"].stop - layout["waypoint"].start


def test_left_and_right_are_alike():
    sign, random = torch.tensor([1.0, -1.0]), torch.Generator().manual_seed(0)
    scene = [torch.randn(50, 2, generator=random) for _ in range(4)]
    place, mirrored = dribble_waypoint(*scene), dribble_waypoint(*(part * sign for part in scene))
    torch.testing.assert_close(mirrored, place * sign)
    for env in (
        Dribble("biped", 1, seed=0, num_threads=1, waypoint=True),
        Heading("biped", 1, seed=0, num_threads=1, waypoint=True, speed=(0.0, 1.0), initial_directions=(0.5, 0.6)),
    ):
        goal = env.reset()["goal"]
        torch.testing.assert_close(env.goal_mirror()(goal)[0, -2:], goal[0, -2:] * sign)
