"""Gates in a row: acts follow one another, weights fade, and the primitives are evaluated once."""

import math

import pytest
import torch
from refusals import refused
from torch import nn

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.envs import Dribble, Heading
from torchrl_mcp.envs.rotations import unit_vector
from torchrl_mcp.envs.tasks.waypoints import place_seen
from torchrl_mcp.methods.sequence import Act, GatesInARow
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.policies import restore
from torchrl_mcp.viewer.player import Player


class Constant(nn.Module):
    """Gate logits that do not depend on the input."""

    def __init__(self, logits):
        super().__init__()
        self.logits = torch.tensor(logits)

    def forward(self, state, goal):
        return self.logits.expand(len(state), -1)


class Primitives(nn.Module):
    """Two primitives with constant outputs, which count their calls."""

    def __init__(self):
        super().__init__()
        self.mean = nn.Parameter(torch.tensor([[0.1], [0.3]]))
        self.calls = 0

    def forward(self, state):
        self.calls += 1
        loc = self.mean.expand(len(state), 2, 17)
        return loc, torch.full_like(loc, 0.1)


def act(primitives, logits, until=None):
    parts = {"observation_normaliser": nn.Identity(), "goal_normaliser": nn.Identity(), "primitives": primitives}
    return Act(nn.ModuleDict({**parts, "gating": Constant(logits)}), until)


def play(env, acts, steps, **settings):
    """Return the gates of every step, ``(steps, N, K)``."""
    policy = GatesInARow(env, acts, **settings)
    state, gates = env.reset(), []
    for _ in range(steps):
        state = policy(state)
        gates.append(state["gates"].clone())
        torch.testing.assert_close(
            state["action"], MultiplicativeGaussian(*acts[0].parts["primitives"](state["observation"]), gates[-1]).mean
        )
        _, state = env.step_and_maybe_reset(state)
    return torch.stack(gates)


def after(*seconds):
    """Over in each simulation after its time."""
    return lambda env: env.episode["elapsed_steps"].flatten() >= torch.tensor(seconds) * 30


def test_weights_fade_linearly_from_one_act_to_the_next_in_every_simulation_at_its_own_time():
    env, primitives = Heading("biped", 2, seed=0, num_threads=1, terminate_on_fall=False), Primitives()
    low, high = math.log(0.2 / 0.8), math.log(0.8 / 0.2)
    acts = [act(primitives, [low, high], after(0.2, 0.4)), act(primitives, [high, high])]
    first = play(env, acts, 20, crossfade=0.3)[..., 0]
    steps = torch.arange(20).unsqueeze(-1)
    expected = 0.2 + 0.6 * ((steps - torch.tensor([6, 12]) + 1) / 9).clamp(0, 1)
    torch.testing.assert_close(first, expected, atol=1e-6, rtol=0)


def test_an_episode_begins_with_the_first_act():
    env, primitives = Heading("biped", 1, seed=0, num_threads=1, max_episode_steps=5), Primitives()
    acts = [act(primitives, [0.0, 0.0], after(0.1)), act(primitives, [20.0, 0.0], after(0.1))]
    first = play(env, acts, 10, crossfade=0.0)[:, 0, 0]  # the last act lasts to the end, also when it is over
    assert first.tolist() == pytest.approx([0.5, 0.5, 0.5, 1.0, 1.0] * 2)


def test_the_primitives_are_evaluated_once_for_all_gates():
    env, primitives = Heading("biped", 1, seed=0, num_threads=1), Primitives()
    acts = [act(primitives, [0.0, 0.0]) for _ in range(5)]
    policy = GatesInARow(env, acts)
    policy(env.reset())
    assert primitives.calls == 1


def test_acts_over_other_primitives_and_bad_durations_are_refused():
    env, here, there = Heading("biped", 1, seed=0, num_threads=1), Primitives(), Primitives()
    with torch.no_grad():
        there.mean.add_(0.1)
    one, other = act(here, [0.0, 0.0]), act(there, [0.0, 0.0])
    refused(lambda: GatesInARow(env, [one, other]), "act 1", "primitives")
    refused(lambda: GatesInARow(env, []), "acts")
    refused(lambda: GatesInARow(env, [one], crossfade=-1.0), "crossfade=-1.0")


@pytest.mark.trajectories
def test_built_in_gates_walk_to_the_ball_and_then_kick_it():
    """The heading gate walks towards the ball; near it, the dribbling gate takes over and the ball moves."""
    settings = {"object_distances": (3.0, 3.0), "object_directions": (0.0, 0.0), "max_episode_steps": 450}
    _, heading, _ = restore(builtin("mcp", "biped", "heading"), num_envs=1, seed=0)
    _, dribble, env = restore(builtin("mcp", "biped", "dribble"), num_envs=1, seed=0, curriculum=None, **settings)
    assert isinstance(env, Dribble)

    def ball():
        return env.pose("ball")[0][:, :2]

    def towards(env):
        way = ball() - env.com[:, :2]
        return unit_vector(torch.atan2(way[:, 1], way[:, 0]) - env.heading())

    def arrived(env):
        return (ball() - env.com[:, :2]).norm(dim=-1) < 1.0

    acts = [Act(heading.parts, arrived, towards), Act(dribble.parts)]
    policy = GatesInARow(env, acts)
    player = Player(policy, env)
    start = ball().clone()
    reached = None
    for step in range(240):
        player.step()
        if reached is None and int(policy.act[0]) == 1:
            reached = step
        if float((ball() - start).norm()) > 0.3:  # 3.0 m in the end, with a standard deviation of 0.7 m
            break
        assert not player.began  # no fall
    else:
        pytest.fail("the ball was not kicked")
    assert reached is not None
    assert 30 < reached < 150  # two metres at about a metre per second


def test_the_place_of_the_location_task_is_seen_in_other_tasks():
    env = Heading("biped", 2, seed=0, num_threads=1)
    env.reset()
    ahead = place_seen(env, env.com[:, :2] + 2.0 * unit_vector(env.heading()))
    expected = torch.tensor([math.log(1 + 2.0 / 0.25), 0.0], dtype=torch.float64)
    torch.testing.assert_close(ahead.double(), expected.expand(2, 2), atol=1e-6, rtol=0)
