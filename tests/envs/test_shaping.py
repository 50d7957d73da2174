import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_mcp.envs import Carry, Dribble, Heading
from torchrl_mcp.envs.shaping import Ramp, potential, shaping_reward
from torchrl_mcp.evaluation.rollout import evaluate
from torchrl_mcp.training.episodes import EpisodeStatistics

RAMPS = {"object": {"slope": 1.0, "reach": 4.0}, "target": {"slope": 2.0, "reach": 3.0}}
NEAR = {"object_distances": (1.0, 3.0), "target_distances": (1.0, 3.0)}
GAMMA = 0.97
every_task = pytest.mark.parametrize("task", [Carry, Dribble])


def make(task, num_envs=4, **kwargs):
    settings = {"seed": 0, "num_threads": 1, "dtype": torch.float64, "discount": GAMMA, **NEAR, **kwargs}
    return task("biped", num_envs, **settings)


def potentials(env):
    """By hand: 4 m less the way to the object, and twice 3 m less the way from there to the target, above 0."""
    state, model, found = env.get_state(), env.simulation.model, []
    for index in range(env.num_envs):
        data = env.simulation.data(index)
        own = range(1, model.body("target").id)
        com = sum(model.body_mass[body] * data.xipos[body] for body in own) / sum(model.body_mass[b] for b in own)
        thing, target = state["qpos"][index, -7:-5], state["mocap_pos"][index, 0, :2]
        ways = math.dist(com[:2], thing), math.dist(thing, target)
        found.append(max(0.0, 4 - ways[0]) + 2 * max(0.0, 3 - ways[1]))
    return torch.tensor(found, dtype=torch.float64)


def play(env, num_steps, scale):
    """Rewards of random actions, and the task's own, ``(T, N)`` each."""
    generator, carrier, rows = torch.Generator().manual_seed(1), env.reset(), []
    for _ in range(num_steps):
        action = scale * (2 * torch.rand(env.action_spec.shape, generator=generator, dtype=torch.float64) - 1)
        step, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        rows.append([step["next", key].squeeze(-1) for key in ("reward", "task_reward")])
    return tuple(torch.stack(column) for column in zip(*rows, strict=True))


def test_a_potential_is_flat_from_its_reach_on_and_nowhere_negative():
    distances = {"a": torch.tensor([0.0, 1.0, 5.0]), "b": torch.tensor([9.0, 0.5, 9.0])}
    found = potential(distances, {"a": Ramp(2.0, 4.0), "b": Ramp(3.0, 1.0)})
    assert found.tolist() == [8.0, 7.5, 0.0]


def test_the_discounted_sum_of_shaping_telescopes_whatever_happens():
    phi = torch.rand(20, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    phi[-1] = 0  # a fall
    rewards = shaping_reward(phi[:-1], phi[1:], GAMMA)
    powers = GAMMA ** torch.arange(19, dtype=torch.float64).unsqueeze(-1)
    torch.testing.assert_close((powers * rewards).sum(0), -phi[0])


@every_task
def test_until_a_fall_the_sum_of_shaping_is_what_the_potential_has_gained(task):
    env = make(task, shaping=RAMPS)
    env.reset()
    state = env.get_state()
    carrier, before, total = env.reset(state, set_state=True), potentials(env), 0.0
    for step in range(8):
        carrier = env.step(carrier.set("action", torch.zeros(env.action_spec.shape, dtype=torch.float64)))["next"]
        total = total + GAMMA**step * (carrier["reward"] - carrier["task_reward"]).squeeze(-1)
    assert not carrier["done"].any()
    torch.testing.assert_close(total, GAMMA**8 * potentials(env) - before)
    assert before.max() > 1


@every_task
def test_a_fall_takes_the_whole_potential_away_and_no_more(task):
    env = make(task, 1, shaping=RAMPS)
    env.reset()
    state = env.get_state()
    state["qpos"][:, 2], state["qpos"][:, 3:7] = 0.05, torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
    state["qpos"][:, -7], state["qpos"][:, -6] = 2.5, 0.0
    before = 5.0
    state["potential"] = torch.full_like(state["potential"], before)  # whatever there was to lose
    carrier = env.reset(state, set_state=True)
    outcome = env.step(carrier.set("action", torch.zeros(env.action_spec.shape, dtype=torch.float64)))["next"]
    assert outcome["terminated"].all()
    assert outcome["task_reward"].item() == 0
    assert outcome["reward"].item() == -before


@every_task
def test_shaping_changes_neither_what_happens_nor_the_reward_of_the_task(task):
    shaped, plain = make(task, shaping=RAMPS), make(task)
    carriers = [env.reset() for env in (shaped, plain)]
    for _ in range(5):
        steps = [
            env.step(carrier.set("action", torch.full(env.action_spec.shape, 0.1, dtype=torch.float64)))["next"]
            for env, carrier in zip((shaped, plain), carriers, strict=True)
        ]
        for key in ("observation", "goal", "done"):
            assert torch.equal(steps[0][key], steps[1][key])
        assert torch.equal(steps[0]["task_reward"], steps[1]["reward"])
        assert not torch.equal(steps[0]["reward"], steps[1]["reward"])
        carriers = steps
    assert "task_reward" not in plain.observation_spec


class Still(torch.nn.Module):
    """A policy without movement."""

    in_keys = ("observation",)

    def forward(self, seen):
        return seen.set("action", torch.zeros(*seen.batch_size, 17, dtype=torch.float64))


@every_task
def test_returns_are_those_of_the_task_in_training_and_in_evaluation(task):
    limit = {"max_episode_steps": 12}
    shaped, plain = (evaluate(Still(), make(task, **limit, **more)) for more in ({"shaping": RAMPS}, {}))
    assert torch.equal(shaped.returns, plain.returns)
    reward, own = play(env := make(task, shaping=RAMPS, **limit), 12, 0.1)
    batch = make_batch(env, reward, own)
    returns, lengths = EpisodeStatistics(4).update(batch)
    torch.testing.assert_close(returns, own.sum(0).float())
    assert lengths.tolist() == [12.0] * 4


def make_batch(env, reward, own):
    """Trajectories ``(N, T)`` that end with their last step."""
    done = torch.zeros(*reward.T.shape, 1, dtype=torch.bool)
    done[:, -1] = True
    outcome = {"reward": reward.T.unsqueeze(-1), "task_reward": own.T.unsqueeze(-1), "done": done}
    return TensorDict({"next": TensorDict(outcome, reward.T.shape)}, reward.T.shape)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shaping": {"height": {"slope": 1.0, "reach": 1.0}}}, "shaping names .*height.*: pass slope and reach of"),
        ({"shaping": {"object": {"slope": -1.0, "reach": 1.0}}}, "shaping.object.slope=-1.0 is out of range"),
        ({"shaping": {"target": {"slope": 1.0, "reach": math.inf}}}, "shaping.target.reach=inf is out of range"),
        ({"discount": 1.5}, "discount=1.5 is out of range"),
    ],
)
def test_wrong_arguments_are_named_with_a_remedy(arguments, message):
    with pytest.raises(ValueError, match=message):
        make(Dribble, **arguments)


def test_a_task_without_distances_has_nothing_to_shape():
    with pytest.raises(ValueError, match=r"shaping names .*object"):
        Heading("biped", 1, num_threads=1, shaping=RAMPS)
