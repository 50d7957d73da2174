import math

import pytest
import torch

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.tasks.rewards import heading_reward, velocity_reward


def make(num_envs=64, **kwargs):
    return Heading("biped", num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


@pytest.mark.parametrize(
    ("velocity", "angle", "reward"),
    [
        ((1.0, 0.0), 0.0, 1.0),
        ((0.0, 1.0), math.pi / 2, 1.0),  # the paper's (cos, -sin) is for a world whose y axis points up
        ((0.0, 0.0), 0.7, math.exp(-4)),
        ((0.5, 3.0), 0.0, math.exp(-1)),
        ((-1.0, 0.0), 0.0, math.exp(-16)),
    ],
)
def test_the_reward_is_that_of_appendix_d(velocity, angle, reward):
    direction = torch.tensor([math.cos(angle), math.sin(angle)])
    assert heading_reward(torch.tensor(velocity), direction, 1.0).item() == pytest.approx(reward, abs=1e-6)


def test_the_direction_wanders_by_a_uniform_step():
    env = make(256, max_turn=0.15)
    env.reset()
    directions = []
    for _ in range(20):
        directions.append(env.episode["direction"].clone())
        env.step(env.rand_action(env.reset(env.get_state(), set_state=True)))
    changes = torch.stack(directions).diff(dim=0).flatten()
    assert changes.abs().max() <= 0.15
    # Of 4,864 draws from Uniform(-0.15, 0.15): mean 0 +- 0.00124, standard deviation 0.0866 +- 0.0006.
    assert changes.mean().abs() < 4 * 0.00124
    assert changes.std().item() == pytest.approx(0.3 / math.sqrt(12), abs=4 * 0.0006)


def test_the_goal_is_the_direction_as_the_character_sees_it():
    env = make(3, initial_directions=(2.0, 2.0))
    state = env.reset()
    torch.testing.assert_close(state["goal"], torch.tensor([[math.cos(2), math.sin(2)]]).expand(3, 2))
    qpos = env.get_state()["qpos"]
    qpos[1, 3:7] = torch.tensor([math.cos(0.5), 0, 0, math.sin(0.5)])  # turned left by 1 rad
    turned = env.reset(env.get_state().update({"qpos": qpos}), set_state=True)
    torch.testing.assert_close(turned["goal"][1], torch.tensor([math.cos(1), math.sin(1)]))
    torch.testing.assert_close(turned["goal"][2], state["goal"][2])


def test_the_velocity_is_the_displacement_of_the_centre_of_mass_towards_the_direction_that_was_seen():
    env = make(2, max_turn=0.15, initial_directions=(0.4, 0.4), dtype=torch.float64)
    carrier = env.reset()
    moved = env.get_state()
    moved["qpos"][:, 2] += 1  # in the air, where nothing pushes
    moved["qvel"][:, 0], moved["qvel"][:, 1] = 0.8, 0.3
    carrier = env.reset(moved, set_state=True).set("action", torch.zeros(2, 17, dtype=torch.float64))
    masses = torch.tensor(env.simulation.model.body_mass)
    before = (masses[:, None] * torch.tensor(env.simulation.data(0).xipos)).sum(0) / masses.sum()
    reward = env.step(carrier)["next", "reward"][0].item()
    after = (masses[:, None] * torch.tensor(env.simulation.data(0).xipos)).sum(0) / masses.sum()
    along = ((after - before)[:2] * 30 @ torch.tensor([math.cos(0.4), math.sin(0.4)], dtype=torch.float64)).item()
    assert along == pytest.approx(0.8 * math.cos(0.4) + 0.3 * math.sin(0.4), abs=1e-6)
    assert reward == pytest.approx(math.exp(-4 * (along - 1) ** 2), rel=1e-9)


def test_first_directions_fill_their_range():
    env = make(512, initial_directions=(-1.0, 2.0))
    env.reset()
    directions = env.episode["direction"]
    assert directions.min() >= -1
    assert directions.max() <= 2
    assert directions.mean().item() == pytest.approx(0.5, abs=4 * 3 / math.sqrt(12 * 512))


def test_the_best_possible_return_is_one_and_the_worst_zero():
    env = make(1, max_episode_steps=50)
    torch.testing.assert_close(env.normalised_return(torch.tensor([0.0, 25.0, 50.0])), torch.tensor([0.0, 0.5, 1.0]))


@pytest.mark.parametrize(
    ("velocity", "target", "reward"),
    [
        ((0.6, 0.8), (0.6, 0.8), 1.0),
        ((0.0, 0.0), (0.0, 0.0), 1.0),
        ((0.0, 0.5), (0.0, 0.0), math.exp(-1)),  # who is to stand must not walk across either
        ((1.0, 0.5), (1.0, 1.0), math.exp(-1)),
    ],
)
def test_the_reward_of_a_velocity_counts_both_of_its_components(velocity, target, reward):
    assert velocity_reward(torch.tensor(velocity), torch.tensor(target)).item() == pytest.approx(reward, abs=1e-6)


def test_with_a_range_of_speeds_the_goal_ends_with_the_speed_that_the_reward_asks_for():
    env = make(512, speed=(0.0, 1.5), initial_directions=(0.3, 0.3), dtype=torch.float64)
    start = env.reset()
    speeds = start["goal"][:, 2]
    assert speeds.min() >= 0
    assert speeds.max() <= 1.5
    assert speeds.mean().item() == pytest.approx(0.75, abs=4 * 1.5 / math.sqrt(12 * 512))
    state = env.get_state()
    state["qpos"][:, 2] += 1  # in the air, where nothing pushes
    state["qvel"][:, 0] = 0.8
    start = env.reset(state, set_state=True).set("action", torch.zeros(512, 17, dtype=torch.float64))
    reward = env.step(start)["next", "reward"].squeeze(-1)
    missing = (0.8 - speeds * math.cos(0.3)).square() + (speeds * math.sin(0.3)).square()
    torch.testing.assert_close(reward, (-4 * missing).exp(), atol=1e-6, rtol=0)


def test_speeds_change_after_a_mean_time_within_their_range():
    env = make(512, speed=(0.5, 1.0), speed_interval=0.5, terminate_on_fall=False)
    state, seen = env.reset(), []
    for _ in range(30):
        seen.append(state["goal"][:, 2])
        state = env.step(state.set("action", torch.zeros(512, 17)))["next"]
    changes = (torch.stack(seen).diff(dim=0) != 0).float()
    # One step in fifteen: of 29 * 512 draws, a share of 0.0667 +- 0.002.
    assert changes.mean().item() == pytest.approx(1 / 15, abs=4 * 0.002)
    assert torch.stack(seen).min() >= 0.5
    assert torch.stack(seen).max() <= 1.0


def test_a_range_without_width_is_the_papers_single_speed():
    one, other = make(4, speed=1.0), make(4, speed=(1.0, 1.0))
    for env in (one, other):
        env.reset()
        for _ in range(5):
            env.update_goal()
    assert torch.equal(one.episode["direction"], other.episode["direction"])
    assert one.speeds == other.speeds
    assert one.observation_spec["goal"].shape == other.observation_spec["goal"].shape == (4, 2)


def test_with_a_range_of_speeds_nobody_knows_what_can_be_reached():
    env = make(1, speed=(0.0, 1.0))
    env.reset()
    assert env.reach() is None


def test_the_arrow_is_as_long_as_the_way_of_a_second():
    env = make(8, speed=(0.0, 1.5), initial_directions=(0.7, 0.7))
    speeds = env.reset()["goal"][:, 2]
    for index, speed in enumerate(speeds.tolist()):
        [(tail, tip)] = env.arrows(index)
        assert (tip - tail).tolist() == pytest.approx([speed * math.cos(0.7), speed * math.sin(0.7), 0.0], abs=1e-6)
