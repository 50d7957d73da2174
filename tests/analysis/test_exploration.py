import math

import numpy as np
import pytest
import torch
from matplotlib.colors import same_color
from tensordict import TensorDict
from torch import nn

from torchrl_mcp.analysis.exploration import (
    FALLEN,
    UPRIGHT,
    Exploration,
    action_noise,
    draw_exploration,
    explore,
    path_rows,
    path_statistics,
)
from torchrl_mcp.envs import Heading


def generator():
    return torch.Generator().manual_seed(0)


def paths(*ends, fallen=(), steps=10, timestep=0.1):
    """Straight lines from the origin; those that fall do so half way."""
    positions = np.linspace(0.0, 1.0, steps + 1)[:, None, None] * np.array(ends, dtype=float)
    ended = np.isin(np.arange(len(ends)), fallen)
    positions[-1] = np.nan  # evaluation does not know the last position
    positions[steps // 2 :, ended] = np.nan
    return Exploration(positions, ended, timestep)


def test_noise_has_the_deviation_asked_for():
    actions = action_noise(4, std=0.3, generator=generator())(torch.zeros(5000, 7))
    assert actions.shape == (5000, 4)
    torch.testing.assert_close(actions.std(0), torch.full((4,), 0.3), atol=0.01, rtol=0)
    torch.testing.assert_close(actions.mean(0), torch.zeros(4), atol=0.02, rtol=0)


def test_who_is_thrown_goes_as_far_as_speed_times_time():
    env = Heading("biped", num_envs=2, seed=0, num_threads=1, max_episode_steps=9)
    model = env.simulation.model
    qpos, qvel = torch.from_numpy(model.qpos0).repeat(2, 1), torch.zeros(2, model.nv, dtype=torch.float64)
    qpos[:, :3] += torch.tensor([3.0, -1.0, 5.0])  # high above the ground, which it does not reach
    qvel[0, :2], qvel[1, :2] = torch.tensor([2.0, 0.0]), torch.tensor([0.0, -1.0])
    at_rest = action_noise(17, std=0.0, generator=generator())
    result = explore(at_rest, nn.Identity(), env, TensorDict({"qpos": qpos, "qvel": qvel}, [2]))
    times = np.arange(9) / 30
    assert result.positions.shape == (10, 2, 2)
    np.testing.assert_allclose(result.positions[:9, 0], np.stack([2 * times, 0 * times], -1), atol=0.01)
    np.testing.assert_allclose(result.positions[:9, 1], np.stack([0 * times, -times], -1), atol=0.01)
    assert np.isnan(result.positions[9]).all()
    assert not result.ended.any()
    np.testing.assert_allclose(result.seconds, 0.3)


def test_a_summary_counts_falls_distances_and_directions():
    result = paths((4.0, 0.0), (0.0, 2.0), (-1.0, 0.0), (0.0, -2.0), fallen=[2])
    numbers = path_statistics(result)
    assert numbers["trajectories"] == 4
    assert numbers["upright"] == 0.75
    np.testing.assert_allclose(result.seconds, [1.0, 1.0, 0.5, 1.0])
    assert numbers["seconds"] == 1.0
    assert numbers["distance"] == pytest.approx(0.9 * 2.0)  # of 3.6, 1.8, 0.4 and 1.8
    assert numbers["spread"] == pytest.approx(1.0)
    assert path_statistics(paths((4.0, 0.0), (1.0, 0.0)))["spread"] == pytest.approx(0.0)
    assert path_statistics(paths((1.0, 0.0), (0.0, 1.0)))["spread"] == pytest.approx(1 - math.sqrt(0.5))


def test_a_path_has_a_row_every_fifth_of_a_second_until_its_end():
    rows = path_rows(paths((1.0, 0.5), (-2.0, 0.0), fallen=[1]))
    assert [(row["seconds"], row["x"], row["y"]) for row in rows if row["trajectory"] == 1] == [
        (0.0, 0.0, 0.0), (0.2, 0.2, 0.1), (0.4, 0.4, 0.2), (0.6, 0.6, 0.3), (0.8, 0.8, 0.4),
    ]  # fmt: skip
    assert [row["seconds"] for row in rows if row["trajectory"] == 2] == [0.0, 0.2, 0.4]


def test_panels_share_one_scale_that_holds_every_path_and_mark_falls():
    far, near = paths((9.0, 3.0), (-3.0, 1.0), fallen=[1]), paths((0.5, 0.0), (0.4, 0.1), fallen=[0, 1])
    figure = draw_exploration({"far": far, "near": near}, title="someone")
    one, other = figure.axes
    assert [axes.get_title().partition("\n")[0] for axes in figure.axes] == ["far", "near"]
    assert one.get_xlim() == other.get_xlim()
    assert one.get_ylim() == other.get_ylim()
    assert np.ptp(one.get_xlim()) == pytest.approx(np.ptp(one.get_ylim()))
    assert one.get_xlim()[0] < -1.2 < 8.1 < one.get_xlim()[1]
    colours = [line.get_color() for line in one.lines]
    assert same_color(colours[0], UPRIGHT)
    assert same_color(colours[1], FALLEN)
    np.testing.assert_allclose(one.collections[0].get_offsets(), [[-1.2, 0.4]])  # where the second was last
    assert not one.child_axes
    [inset] = other.child_axes  # its paths are too short to be seen
    assert inset.get_xlim()[1] == pytest.approx(1.1 * 0.2)
