import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_mcp.envs import Holdout

CONTACTS = pytest.mark.parametrize("contact_forces", [False, True], ids=["no_contacts", "contacts"])


def gymnasiums_ant(**kwargs):
    pytest.importorskip("imageio", reason="Gymnasium's MuJoCo environments need imageio: pip install imageio")
    from gymnasium.envs.mujoco.ant_v5 import AntEnv

    return AntEnv(**kwargs)


def side_by_side(num_envs, contact_forces, terminate_when_unhealthy):
    """Gymnasium's ants after a reset, and ours in the same states with +x as direction, in float64."""
    without = {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0}
    theirs = [
        gymnasiums_ant(terminate_when_unhealthy=terminate_when_unhealthy, **({} if contact_forces else without))
        for _ in range(num_envs)
    ]
    first = [env.reset(seed=seed)[0] for seed, env in enumerate(theirs)]
    ours = Holdout(
        num_envs,
        (0.0, 0.0),
        num_threads=1,
        contact_forces=contact_forces,
        terminate_when_unhealthy=terminate_when_unhealthy,
        max_episode_steps=10_000,
        dtype=torch.float64,
    )
    qpos, qvel = (torch.stack([torch.tensor(getattr(env.data, key)) for env in theirs]) for key in ("qpos", "qvel"))
    carrier = ours.reset(TensorDict({"qpos": qpos, "qvel": qvel}, [num_envs]), set_state=True)
    assert torch.equal(carrier["observation"], torch.tensor(np.stack(first)))
    return theirs, ours, carrier


@CONTACTS
def test_a_thousand_steps_are_gymnasiums_bit_for_bit(contact_forces):
    theirs, ours, carrier = side_by_side(2, contact_forces, terminate_when_unhealthy=False)
    script = torch.rand(1000, 2, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for step, action in enumerate(script):
        carrier = ours.step(carrier.set("action", action))["next"]
        for index, env in enumerate(theirs):
            observation, reward, *_ = env.step(action[index].numpy())
            assert torch.equal(ours.simulation.state["qpos"][index], torch.tensor(env.data.qpos)), step
            assert torch.equal(ours.simulation.state["qvel"][index], torch.tensor(env.data.qvel)), step
            assert torch.equal(carrier["observation"][index], torch.tensor(observation)), step
            assert abs(carrier["reward"][index].item() - reward) < 1e-9, step


def test_episodes_end_where_gymnasiums_do():
    theirs, ours, carrier = side_by_side(6, contact_forces=False, terminate_when_unhealthy=True)
    script = torch.rand(400, 6, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 1
    alive = set(range(6))
    for action in script:
        carrier = ours.step(carrier.set("action", action))["next"]
        for index in list(alive):
            _, _, terminated, _, _ = theirs[index].step(action[index].numpy())
            assert carrier["terminated"][index].item() == terminated
            if terminated:
                alive.remove(index)
    assert len(alive) < 6


def test_each_step_earns_the_speed_in_the_direction_of_its_goal():
    env = Holdout(4, (0.0, 0.0), seed=0, num_threads=1, dtype=torch.float64)
    env.reset()
    state = env.get_state()[[0, 0, 0, 0]].clone()
    state["goal"] = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.6, 0.8]], dtype=torch.float64)
    carrier = env.reset(state, set_state=True)
    reward = env.step(carrier.set("action", torch.full((4, 8), 0.5, dtype=torch.float64)))["next", "reward"].squeeze()
    rest = (reward[0] + reward[1]) / 2
    torch.testing.assert_close(rest.item(), 1.0 - 0.5 * 8 * 0.25)
    along_x, along_y, along_both = reward[[0, 2, 3]] - rest
    torch.testing.assert_close(along_both, 0.6 * along_x + 0.8 * along_y)


@CONTACTS
def test_the_observation_has_gymnasiums_size(contact_forces):
    env = Holdout(3, (0.0, 1.0), num_threads=1, contact_forces=contact_forces)
    size = gymnasiums_ant(include_cfrc_ext_in_observation=contact_forces).observation_space.shape[0]
    assert env.observation_spec["observation"].shape == (3, size)
    assert size == (105 if contact_forces else 27)


def test_goals_are_directions_drawn_evenly_from_the_interval():
    low, high = 1.5 * math.pi, 2 * math.pi
    goal = Holdout(4000, (low, high), seed=0, num_threads=1).reset()["goal"]
    torch.testing.assert_close(goal.norm(dim=-1), torch.ones(4000))
    share = (torch.atan2(goal[:, 1], goal[:, 0]) % (2 * math.pi) - low) / (high - low)
    assert ((share > -1e-6) & (share < 1 + 1e-6)).all()
    quarters = torch.histc(share, 4, 0, 1)
    assert (quarters - 1000).abs().max() < 5 * math.sqrt(1000 * 0.75)


def test_a_goal_lasts_for_its_episode():
    env = Holdout(8, (0.0, 6.0), seed=0, num_threads=1, max_episode_steps=6, terminate_when_unhealthy=False)
    goal = env.rollout(12, break_when_any_done=False)["goal"]
    assert (goal[:, :6] == goal[:, :1]).all()
    assert (goal[:, 6:] == goal[:, 6:7]).all()
    assert (goal[:, 0] != goal[:, 6]).any(-1).all()


def test_episodes_begin_around_the_models_pose():
    env = Holdout(2000, (0.0, 1.0), seed=0, num_threads=1, reset_noise_scale=0.1)
    env.reset()
    shift = env.simulation.state["qpos"] - torch.tensor(env.simulation.model.qpos0)
    assert 0.099 < shift.abs().max() <= 0.1
    assert shift.mean().abs() < 0.002
    assert env.simulation.state["qvel"].std() == pytest.approx(0.1, rel=0.03)


def test_without_noise_every_episode_begins_alike():
    env = Holdout(3, (0.0, 1.0), num_threads=1, reset_noise_scale=0.0)
    assert (env.reset()["observation"].diff(dim=0) == 0).all()


def test_the_normalised_return_is_one_at_gymnasiums_threshold_whatever_the_time_limit():
    returns = torch.tensor([0.0, 6000.0, -600.0])
    assert Holdout(1, (0.0, 1.0), num_threads=1).normalised_return(returns).tolist() == pytest.approx([0.0, 1.0, -0.1])
    short = Holdout(1, (0.0, 1.0), num_threads=1, max_episode_steps=200)
    assert short.normalised_return(torch.tensor(1200.0)).item() == pytest.approx(1.0)
