import math

import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Location
from torchrl_mcp.envs.steering import UserGoal
from torchrl_mcp.envs.tasks.rewards import location_reward
from torchrl_mcp.envs.tasks.waypoints import walkable


def make(num_envs=4, **kwargs):
    return Location("biped", num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def stand(env, **places):
    """Begin with the characters at rest in the air, where nothing pushes, and the given task state."""
    env.reset()
    state = env.get_state()
    state["qpos"][:, 2] += 5.0
    for name, value in places.items():
        state[name] = torch.as_tensor(value, dtype=state[name].dtype).expand_as(state[name]).clone()
    return env.reset(state, set_state=True).set(
        "action", torch.zeros(env.action_spec.shape, dtype=env.action_spec.dtype)
    )


def vector(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def polar(distance, degrees):
    return distance * vector(math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))


@pytest.mark.parametrize(
    ("velocity", "offset", "alignment", "reward"),
    [
        ((0.0, 0.0), (0.0, 0.0), 1.0, 1.0),
        ((0.0, 0.0), (0.2, 0.0), 1.0, 0.4 * math.exp(-0.04) + 0.6),
        ((0.0, 1.0), (0.0, 8.0), 1.0, 0.6 + 0.4 * math.exp(-64)),
        ((0.0, 0.0), (0.0, 8.0), 1.0, 0.6 * math.exp(-4)),
        ((1.0, 0.5), (8.0, 0.0), 1.0, 0.6 * math.exp(-1)),  # motion across counts
        ((0.6, 0.5), (0.6, 0.0), 1.0, 0.4 * math.exp(-0.36) + 0.6 * math.exp(-1)),  # in the last metre
        ((0.0, -0.8), (0.0, -0.8), 1.0, 0.4 * math.exp(-0.64) + 0.6),  # and the speed falls
        ((0.0, 0.0), (0.5, 0.0), 1.0, 0.4 * math.exp(-0.25) + 0.6 * math.exp(-1)),
        ((0.0, 0.5), (0.1, 0.0), 1.0, 0.4 * math.exp(-0.01) + 0.6 * math.exp(-1)),  # at the place, standing still
        ((0.0, 0.0), (0.0, 0.0), -1.0, 0.6),  # at the place, back to front
        ((0.0, 0.0), (0.0, 0.0), 0.0, 0.8),
    ],
)
def test_the_reward_is_one_for_standing_at_the_place(velocity, offset, alignment, reward):
    found = location_reward(vector(*velocity), vector(*offset), 1.0, alignment)
    assert found.item() == pytest.approx(reward, abs=1e-12)


def test_the_reward_of_a_step_is_for_the_displacement_of_the_centre_of_mass_and_the_place_that_was_seen():
    env = make(2, dtype=torch.float64, target_intervals=(1 / 30, 1 / 30))
    start = stand(env, target=[2.0, 1.0], seconds_left=1 / 30)
    state = env.get_state()
    state["qvel"][:, 0], state["qvel"][:, 1] = 0.7, 0.2
    action = start["action"]
    start = env.reset(state, set_state=True).set("action", action)
    before = _centre(env)
    after = env.step(start)["next"]
    velocity, offset = (_centre(env) - before) * 30, np.array([2.0, 1.0]) - _centre(env)
    aim = offset / np.linalg.norm(offset)
    expected = 0.4 * math.exp(-(offset @ offset)) + 0.6 * math.exp(-4 * np.sum((velocity - aim) ** 2))
    assert after["reward"][0].item() == pytest.approx(expected, rel=1e-9)
    assert not torch.equal(env.episode["target"][0], vector(2.0, 1.0))  # drawn after the reward


def test_who_could_not_move_at_its_place_has_not_succeeded():
    env = make(2)
    start = stand(env)
    start = env.reset(env.get_state().set("target", env.com[:, :2].clone()), set_state=True)
    action = torch.zeros(env.action_spec.shape)
    action[0] = torch.nan
    after = env.step(start.set("action", action))["next"]
    assert after["terminated"].flatten().tolist() == [True, False]
    assert after["success"].flatten().tolist() == [False, True]
    assert env.episode["reached"].tolist() == [False, True]


def _centre(env):
    """Centre of mass of the first simulation, from MuJoCo's positions and masses."""
    data, masses = env.simulation.data(0), env.simulation.model.body_mass
    return (masses @ data.xipos / masses.sum())[:2]


def test_the_goal_is_the_place_in_the_characters_frame_with_a_logarithmic_distance():
    env = make(2, dtype=torch.float64)
    env.reset()
    state = env.get_state()
    state["qpos"][:, 3:7] = torch.tensor([math.cos(0.5), 0.0, 0.0, math.sin(0.5)])  # turned left by 1 rad
    env.reset(state, set_state=True)
    place = _centre(env) + 2.0 * np.array([math.cos(1.5), math.sin(1.5)])  # half a radian further to the left
    state = env.get_state()
    state["target"][:] = torch.from_numpy(place)
    goal = env.reset(state, set_state=True)["goal"][0]
    expected = math.log(1 + 2.0 / 0.25) * vector(math.cos(0.5), math.sin(0.5))
    torch.testing.assert_close(goal, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("place", "seen"),
    [
        ((3.0, 30), (3.0, 30)),
        ((3.0, 44), (3.0, 44)),
        ((3.0, 46), (0.5, 45)),
        ((8.0, -100), (0.5, -45)),
        ((0.6, 170), (0.5, 45)),
        ((0.4, 170), (0.4, 170)),  # a step back
        ((0.4, -60), (0.4, -60)),
        ((0.25, 40), (0.25, 40)),
        ((0.25, -60), (0.0, 0)),  # reached
        ((0.25, 180), (0.0, 0)),
        ((0.0, 0), (0.0, 0)),
    ],
)
def test_a_place_aside_is_seen_where_the_character_can_walk(place, seen):
    torch.testing.assert_close(walkable(polar(*place)), polar(*seen))


def test_the_goal_ends_with_the_direction_to_face_if_there_is_one():
    env = make(512, final_directions=(0.5, 1.0))
    angles = torch.atan2(*env.reset()["goal"][:, [3, 2]].unbind(-1))
    assert env.observation_spec["goal"].shape == (512, 4)
    assert angles.min() >= 0.5
    assert angles.max() <= 1.0
    assert angles.mean().item() == pytest.approx(0.75, abs=4 * 0.5 / math.sqrt(12 * 512))
    torch.testing.assert_close(env.episode["final_direction"].float(), angles)  # characters begin facing along x


def test_places_fill_the_disc_around_the_character():
    env = make(2048, target_distances=(1.0, 4.0), target_directions=(-math.pi, math.pi))
    env.reset()
    target = env.episode["target"]
    distances = target.norm(dim=-1)
    assert distances.min() >= 1.0
    assert distances.max() <= 4.0
    assert distances.mean().item() == pytest.approx(2.5, abs=4 * 3 / math.sqrt(12 * 2048))
    assert (torch.nn.functional.normalize(target).mean(0).abs() < 4 / math.sqrt(2 * 2048)).all()


def test_another_place_is_drawn_around_the_character_when_the_time_is_over_and_only_then():
    env = make(64, target_intervals=(0.1, 0.5), target_distances=(2.0, 2.0), terminate_on_fall=False)
    state = env.reset()
    due = (env.episode["seconds_left"] * 30).round().long()
    changed_at = torch.zeros(64, dtype=torch.int64)
    for step in range(1, 16):
        before = env.episode["target"].clone()
        state = env.step(state.set("action", torch.zeros(env.action_spec.shape)))["next"]
        moved = (env.episode["target"] != before).any(-1)
        torch.testing.assert_close((env.episode["target"] - env.com[:, :2])[moved].norm(dim=-1),
                                   torch.full((int(moved.sum()),), 2.0, dtype=torch.float64))  # fmt: skip
        changed_at = torch.where(moved & (changed_at == 0), step, changed_at)
    assert torch.equal(changed_at, due.clamp(min=1))
    assert set(due.tolist()) >= {4, 8, 12}


@pytest.mark.parametrize(
    ("away", "speed", "success", "at_place"),
    [(0.2, 0.05, True, 1.0), (0.2, 0.2, False, 1.0), (0.4, 0.05, False, 0.0)],
)
def test_success_is_standing_at_the_place(away, speed, success, at_place):
    env = make(2)
    stand(env)
    state = env.get_state()
    state["target"][:] = env.com[:, :2] + vector(0.0, away)
    state["qvel"][:, 0] = speed
    start = env.reset(state, set_state=True).set("action", torch.zeros(env.action_spec.shape))
    after = env.step(start)["next"]
    assert after["success"].flatten().tolist() == [success] * 2
    assert after["at_place"].flatten().tolist() == [at_place] * 2


@pytest.mark.parametrize(("degrees", "success"), [(25.0, True), (-25.0, True), (35.0, False), (180.0, False)])
def test_success_needs_the_direction_to_face_if_there_is_one(degrees, success):
    env = make(1, final_directions=(0.0, 0.0))
    stand(env)
    state = env.get_state()
    state["target"][:], state["final_direction"][:] = env.com[:, :2], math.radians(degrees)
    start = env.reset(state, set_state=True).set("action", torch.zeros(env.action_spec.shape))
    assert env.step(start)["next", "success"].item() == success


def test_a_fallen_character_has_no_success():
    env = make(1, terminate_on_fall=False)
    env.reset()
    state = env.get_state()
    state["qpos"][:, 2], state["qpos"][:, 3:7] = 0.15, vector(math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # on its front
    carrier = env.reset(state, set_state=True)
    seen = []
    for _ in range(40):
        env.episode["target"].copy_(env.com[:, :2])
        before = env.com[0, :2].clone()
        carrier = env.step(carrier.set("action", torch.zeros(env.action_spec.shape)))["next"]
        speed = 30 * (env.com[0, :2] - before).norm()
        seen.append((env.simulation.data(0).body("torso").xpos[2] < 0.3, speed < 0.1, carrier["success"].item()))
    lying = [bool(success) for low, slow, success in seen[10:] if low and slow]  # after the drop to the ground
    assert len(lying) > 10
    assert not any(lying)


@pytest.mark.parametrize("interval", [1.0, 9.0])  # as long as the episode, and longer
def test_the_mean_of_the_time_to_success_over_an_episode_is_the_time_it_took(interval):
    env = make(1, max_episode_steps=30, target_intervals=(interval, interval), terminate_on_fall=False)
    carrier, seconds = stand(env, target=[5.0, 0.0]), []
    for step in range(30):
        if step == 12:  # the place comes to the character
            env.episode["target"].copy_(env.com[:, :2])
        elif step == 20:  # it stays reached
            env.episode["target"].add_(5.0)
        action = torch.zeros(env.action_spec.shape)
        carrier = env.step(carrier.set("action", action))["next"]
        seconds.append(carrier["seconds_to_success"].item())
    assert np.mean(seconds) == pytest.approx(12 / 30, abs=1e-6)


def test_the_ideal_player_walks_straight_to_the_place_and_waits():
    env = make(3, max_episode_steps=90, target_intervals=(3.0, 3.0))
    env.reset()
    state = env.get_state()
    state["target"][:] = env.com[:, :2] + vector(0.0, 1.5)
    env.reset(state, set_state=True)
    standing, ideal = env.reach()
    expected = sum(0.6 + 0.4 * math.exp(-(max(1.5 - step / 30, 0.0) ** 2)) for step in range(1, 91))
    torch.testing.assert_close(ideal, vector(expected).expand(3))
    still = 90 * (0.4 * math.exp(-2.25) + 0.6 * math.exp(-4))
    torch.testing.assert_close(standing, vector(still).expand(3))


def test_nobody_knows_what_can_be_reached_where_places_change():
    env = make(1)
    env.reset()
    assert env.reach() is None


def test_the_arrow_points_down_to_the_place_and_another_where_to_face():
    env = make(1, final_directions=(1.0, 1.0))
    env.reset()
    (tail, tip), (back, front) = env.arrows(0)
    target = env.episode["target"][0].numpy()
    np.testing.assert_allclose(tip, [*target, 0.0])
    np.testing.assert_allclose(tail, [*target, 1.0])
    assert math.atan2(*(front - back)[1::-1]) == pytest.approx(1.0)
    assert len(make(1).arrows(0)) == 1


def test_a_snapshot_keeps_a_place_that_the_user_set():
    env = make(1)
    env.reset()
    env.steer(UserGoal(place=(2.0, -1.0)))
    state = env.get_state()
    env.reset(state, set_state=True)
    assert env.episode["target"][0].tolist() == [2.0, -1.0]


def test_a_snapshot_keeps_the_place():
    env = make(3)
    env.reset()
    state = env.get_state()
    again = make(3, seed=7)
    again.reset(state, set_state=True)
    assert torch.equal(again.episode["target"], state["target"])
