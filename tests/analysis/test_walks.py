import math

import numpy as np
import pytest
import torch
from refusals import refused
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from torchrl_mcp.analysis.walk_cycle import draw_walk_cycle
from torchrl_mcp.analysis.walks import (
    action_rows,
    complete_strides,
    cycle_rows,
    primitive_rows,
    record_walk,
    specialisation,
    swings,
)
from torchrl_mcp.envs import Imitation
from torchrl_mcp.envs.motions.single import single_motion

PERIOD, STEPS = 30, 150


def steps(num_walkers=2):
    """Walkers a stride of 30 steps apart in nothing: one weight follows the left foot, one the right, one neither."""
    step = torch.arange(STEPS).expand(num_walkers, -1)
    standing = torch.stack([step % PERIOD < 18, (step + PERIOD // 2) % PERIOD < 18], -1)
    generator = torch.Generator().manual_seed(0)
    gates = torch.cat(
        [0.1 + 0.8 * standing.flip(-1), torch.rand(num_walkers, STEPS, 1, generator=generator)], -1
    ).float()
    apart = 5 * torch.eye(3, 4)
    loc = apart + torch.randn(num_walkers, STEPS, 3, 4, generator=generator)
    content = {
        "observation": step.unsqueeze(-1).float(),
        "goal": torch.zeros(num_walkers, STEPS, 1),
        "gates": gates,
        "primitives": TensorDict({"loc": loc}, [num_walkers, STEPS]),
        "standing": standing,
        "running": torch.ones(num_walkers, STEPS, dtype=torch.bool),
    }
    return TensorDict(content, [num_walkers, STEPS])


def test_complete_strides_are_kept_with_all_that_belongs_to_them():
    walk = complete_strides(steps(), 1 / 30)
    assert (walk.strides, walk.seconds) == (6, pytest.approx(1.0))  # from 30 to 120, of two walkers
    assert walk.inputs["observation"].squeeze().tolist() == [*range(30, 120)] * 2
    np.testing.assert_allclose(walk.phases, np.tile(np.arange(30) / 30, 6))
    np.testing.assert_allclose(walk.gates[:, :2], 0.1 + 0.8 * walk.standing[:, ::-1], rtol=1e-6)
    assert walk.actions.shape == (180, 3, 4)


def test_a_walker_counts_until_it_falls():
    recorded = steps()
    recorded["running"][1, 100:] = False  # in its third stride
    assert complete_strides(recorded, 1 / 30).strides == 5


def test_who_does_not_walk_has_no_stride():
    recorded = steps()
    recorded["standing"][:] = True
    refused(lambda: complete_strides(recorded, 1 / 30), "stride")


def test_numbers_tell_left_right_and_random_primitives_apart():
    walk = complete_strides(steps(8), 1 / 30)
    left, right, random = primitive_rows(walk)
    assert [row["primitive"] for row in (left, right, random)] == [1, 2, 3]
    assert left["stance_correlation"] == pytest.approx(-right["stance_correlation"])
    assert left["stance_correlation"] > 0.8 > 0.2 > abs(random["stance_correlation"])
    assert min(left["explained_by_phase"], right["explained_by_phase"]) > 0.9 > 0.2 > random["explained_by_phase"]
    np.testing.assert_allclose(swings(walk)[:2], 0.8, atol=1e-6)
    numbers = specialisation(walk)
    assert numbers["left"] == left["stance_correlation"]
    assert numbers["right"] == pytest.approx(-right["stance_correlation"])
    # Of 12 coordinates of variance 1, three are 5 for one primitive and 0 for the others: 25 (1/3 - 1/9) each.
    assert numbers["between"] == pytest.approx(3 * 25 * 2 / 9 / (4 + 3 * 25 * 2 / 9), abs=0.04)
    assert numbers["silhouette"] == pytest.approx(np.mean([row["silhouette"] for row in (left, right, random)]))


def test_rows_of_the_cycle_say_when_feet_stand_and_how_weights_spread():
    rows = cycle_rows(complete_strides(steps(8), 1 / 30))
    assert len(rows) == 20 * 3
    for row in rows:
        assert row["low"] <= row["mean"] <= row["high"]
    first = {round(row["phase"], 3): row for row in rows if row["primitive"] == 1}
    assert [first[phase]["right_foot"] for phase in (0.025, 0.525, 0.625, 0.975)] == [1, 1, 0, 0]
    assert [first[phase]["left_foot"] for phase in (0.025, 0.225, 0.525, 0.975)] == [1, 0, 1, 1]
    assert first[0.225]["mean"] == pytest.approx(0.1)
    assert first[0.725]["mean"] == pytest.approx(0.9)


def test_the_figure_draws_every_weight_and_every_action():
    walk = complete_strides(steps(8), 1 / 30)
    figure = draw_walk_cycle(walk, specialisation(walk), title="someone")
    panels = [axes for part in figure.subfigs for axes in part.axes if axes.get_visible()]
    weights = {axes.get_title(loc="left").partition(",")[0]: axes for axes in panels}
    for number in (1, 2, 3):
        axes = weights[f"primitive {number}"]
        expected = [row["mean"] for row in cycle_rows(walk) if row["primitive"] == number]
        np.testing.assert_allclose(axes.lines[0].get_ydata(), expected)
    drawn = np.concatenate([cloud.get_offsets() for cloud in panels[-1].collections])
    points = sorted((row["component_1"], row["component_2"]) for row in action_rows(walk))
    np.testing.assert_allclose(sorted(map(tuple, drawn)), points)


class Follower(torch.nn.Module):
    """Plays nothing, weighs at random, and remembers what it saw."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, observation, goal):
        self.seen.append((observation.clone(), goal.clone()))
        num = len(observation)
        return torch.zeros(num, 17), torch.rand(num, 3), torch.zeros(num, 3, 17)


def test_walkers_begin_at_different_moments_of_the_walk_and_are_asked_in_every_step():
    terms = {"pose": {"weight": 1.0, "scale": 1.0}}
    env = Imitation(
        "biped", single_motion("biped"), 5, terms=terms, switch_interval=math.inf, seed=0, num_threads=1, max_error=9.0
    )
    follower = Follower()
    policy = TensorDictModule(
        follower, in_keys=["observation", "goal"], out_keys=["action", "gates", ("primitives", "loc")]
    )
    refused(lambda: record_walk(policy, env, seconds=0.5), "stride")
    assert len(follower.seen) == 15
    refused(lambda: record_walk(policy, env, seconds=0.001), "stride")
    first, _ = follower.seen[0]
    distances = torch.cdist(first, first) + 9 * torch.eye(5)
    assert distances.min() > 0.1
