import math

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from refusals import refused
from tensordict.nn import TensorDictModule

from torchrl_mcp.analysis import (
    Trajectories,
    draw_trajectories,
    play_directions,
    save_figure,
)
from torchrl_mcp.envs import Holdout

TURN = 2 * math.pi


def rays(directions, length=5.0, num_steps=20):
    """Perfect paths: straight towards their directions."""
    directions = np.asarray(directions)
    distance = np.linspace(0.0, length, num_steps)[:, None, None]
    return Trajectories(directions, distance * np.stack([np.cos(directions), np.sin(directions)], -1))


class Listener(torch.nn.Module):
    """Stands still and remembers what it was told."""

    def __init__(self):
        super().__init__()
        self.goals = []

    def forward(self, goal):
        self.goals.append(goal.clone())
        return torch.zeros(len(goal), 8)


def play(directions, **kwargs):
    listener = Listener()
    env = Holdout(len(directions), (0.0, 0.1), seed=0, num_threads=1, max_episode_steps=5, **kwargs)
    policy = TensorDictModule(listener, in_keys=["goal"], out_keys=["action"])
    return play_directions(policy, env, torch.tensor(directions)), listener


def test_the_policy_is_told_the_directions_asked_for_in_every_step():
    directions = [0.0, 1.0, 4.0]
    trajectories, listener = play(directions)
    expected = torch.tensor([[math.cos(angle), math.sin(angle)] for angle in directions])
    assert len(listener.goals) == 5
    for goal in listener.goals:
        torch.testing.assert_close(goal, expected)
    np.testing.assert_allclose(trajectories.directions, directions)


def test_positions_are_metres_from_the_origin_until_the_episode_ends():
    trajectories, _ = play([0.0, 1.0], reset_noise_scale=0.0)
    assert trajectories.positions.shape == (5, 2, 2)
    np.testing.assert_allclose(trajectories.positions[:4], 0.0, atol=0.05)
    assert np.isnan(trajectories.positions[4]).all()


def test_one_direction_per_environment_is_required():
    env = Holdout(2, (0.0, 1.0), seed=0, num_threads=1)
    policy = TensorDictModule(Listener(), in_keys=["goal"], out_keys=["action"])
    refused(lambda: play_directions(policy, env, torch.zeros(3)), "directions")


def marks(axes):
    return axes.collections[0].get_offsets(), axes.collections[0].get_facecolors()[:, :3]


def paths(axes, num):
    return axes.lines[-num:]


def test_perfect_paths_point_at_the_mark_of_their_colour():
    directions = np.linspace(0.0, TURN, 16, endpoint=False)
    axes = draw_trajectories({"": rays(directions)}).axes[0]
    offsets, colours = marks(axes)
    for line, offset, colour in zip(paths(axes, 16), offsets, colours, strict=True):
        end = line.get_xydata()[-1]
        np.testing.assert_allclose(end / np.linalg.norm(end), offset / np.linalg.norm(offset), atol=1e-6)
        np.testing.assert_allclose(to_rgb(line.get_color()), colour)


def test_colours_go_round_in_a_circle():
    directions = np.linspace(0.0, TURN, 181)
    _, colours = marks(draw_trajectories({"": rays(directions)}).axes[0])
    np.testing.assert_allclose(colours[0], colours[-1])
    assert np.abs(np.diff(colours, axis=0)).max() < 0.05


def test_neighbours_fifteen_degrees_apart_have_different_colours():
    _, colours = marks(draw_trajectories({"": rays(np.radians(range(0, 360, 15)))}).axes[0])
    assert np.linalg.norm(colours[:, None] - colours[None], axis=-1)[~np.eye(24, dtype=bool)].min() > 0.05


def test_panels_have_one_scale_equal_in_x_and_y_that_holds_every_path():
    figure = draw_trajectories({"short": rays([0.0, 2.0], length=1.0), "long": rays([4.0], length=17.0)})
    assert [axes.get_title() for axes in figure.axes] == ["short", "long"]
    assert len({axes.get_xlim() + axes.get_ylim() for axes in figure.axes}) == 1
    for axes in figure.axes:
        assert axes.get_aspect() == 1.0
        assert axes.get_xlim()[1] > 17.0
        offsets, _ = marks(axes)
        assert (np.linalg.norm(offsets, axis=-1) > 17.0).all()
        assert (np.abs(offsets) < axes.get_xlim()[1]).all()


@pytest.mark.parametrize("length", [0.004, 0.7, 3.0, 99.0, 260.0])
def test_rings_are_round_distances_around_every_path(length):
    figure = draw_trajectories({"": rays([0.0], length=length)})
    radii = [line.get_xydata()[0][0] for line in figure.axes[0].lines[:-1]]
    assert 1 <= len(radii) <= 4
    assert radii[-1] >= length > radii[-1] / 4
    np.testing.assert_allclose(np.diff(radii), radii[0])
    assert figure.get_supxlabel().startswith(f"rings: {radii[0]:g} m apart")


@pytest.mark.parametrize("fallen", [[0], [0, 1]], ids=["one", "all"])
def test_episodes_that_end_at_once_leave_no_path_but_do_no_harm(tmp_path, fallen):
    trajectories = rays([0.0, 1.0])
    trajectories.positions[:, fallen] = np.nan
    png, _ = save_figure(draw_trajectories({"": trajectories}), tmp_path / "paths")
    assert imread(png).std() > 0.01
