"""What training may use beside the task itself, and what the task's own reward then is."""

import math

import numpy as np
import pytest
import torch
from refusals import refused

from torchrl_mcp.envs import Carry, Dribble, Heading

WEIGHTS = [0.6, 0.1, 1.0, 2.0]
WEIGHED = {"reward_weights": WEIGHTS}
SCALE = {Carry: 0.25, Dribble: 0.5}
every_task = pytest.mark.parametrize("task", [Carry, Dribble])


def make(task, num_envs=4, **kwargs):
    return task("biped", num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def outcomes(env, num_steps=12, push=0.2):
    """What the environment says after each step of random actions, and where all was before and after it."""
    generator, state, seen = torch.Generator().manual_seed(0), env.reset(), []
    for _ in range(num_steps):
        before = places(env)
        action = push * (2 * torch.rand(env.action_spec.shape, generator=generator) - 1)
        state = env.step(state.set("action", action))["next"]
        seen.append((state.clone(), before, places(env)))
    return seen


def places(env):
    """Centre of mass, object and target on the ground, by MuJoCo's own names, each ``(N, 2)``."""
    found = []
    for index in range(env.num_envs):
        data, model = env.simulation.data(index), env.simulation.model
        found.append(np.array([data.subtree_com[1], data.body(model.nbody - 1).xpos, data.body("target").xpos]))
    return np.stack(found, 1)[..., :2]


@every_task
def test_what_is_learnt_from_counts_speeds_from_standing_still(task):
    for state, before, (com, thing, target) in outcomes(make(task, curriculum=WEIGHED, terminate_on_fall=False)):
        ahead, left = thing - com, target - thing
        pace = ((com - before[0]) * 30 * ahead).sum(-1) / np.linalg.norm(ahead, axis=-1)
        progress = ((thing - before[1]) * 30 * left).sum(-1) / np.linalg.norm(left, axis=-1)
        expected = 0.6 * (np.exp(-1.5 * np.minimum(0, pace - 1) ** 2) - math.exp(-1.5))
        expected += 0.1 * np.exp(-SCALE[task] * (ahead**2).sum(-1))
        expected += 1.0 * (np.exp(-(np.minimum(0, progress - 1) ** 2)) - math.exp(-1))
        expected += 2.0 * np.exp(-0.5 * np.linalg.norm(left, axis=-1))
        np.testing.assert_allclose(state["reward"].squeeze(-1), expected, atol=1e-5)


AT_THE_TARGET = {"object_distances": (0.5, 0.6), "target_distances": (0.0, 0.1), "terminate_on_fall": False}


def stand(env, state):
    """Step simulations in which the character stands, and begin new episodes after ended ones."""
    taken, state = env.step_and_maybe_reset(state.set("action", torch.zeros(env.action_spec.shape)))
    return taken["next"], state


@pytest.mark.parametrize("worth", [1, 2.5])
def test_every_step_in_success_earns_its_worth_of_the_full_reward_and_does_not_end_the_episode(worth):
    env = make(Dribble, curriculum={**WEIGHED, "success_worth": worth}, **AT_THE_TARGET)
    full = 0.6 * (1 - math.exp(-1.5)) + 0.1 + 1.0 * (1 - math.exp(-1)) + 2.0
    state = env.reset()
    for _ in range(3):
        outcome, state = stand(env, state)
        assert outcome["success"].all()
        assert not outcome["terminated"].any()
        torch.testing.assert_close(outcome["reward"], torch.full((4, 1), worth * full))


def test_without_weights_a_success_does_not_end_the_episode():
    outcome = outcomes(make(Dribble, **AT_THE_TARGET), 1)[0][0]
    assert outcome["success"].all()
    assert not outcome["terminated"].any()


@every_task
def test_the_task_reward_is_that_of_the_task_without_weights(task):
    weighed = outcomes(make(task, curriculum=WEIGHED))
    plain = outcomes(make(task))
    for (one, *_), (other, *_) in zip(weighed, plain, strict=True):
        assert torch.equal(one["task_reward"], other["reward"])
        assert "task_reward" not in other
        assert not torch.equal(one["reward"], other["reward"])


@every_task
def test_who_has_fallen_earns_neither(task):
    fell = torch.zeros(4, 1, dtype=torch.bool)
    for state, *_ in outcomes(make(task, curriculum=WEIGHED), 60, push=1.0):
        ended = state["terminated"]
        assert (state["reward"][ended] == 0).all()
        assert (state["task_reward"][ended] == 0).all()
        fell |= ended
    assert fell.any()


def test_standing_still_far_from_everything_earns_nothing():
    far = {"object_distances": (9.0, 10.0), "target_distances": (9.0, 10.0)}
    state = outcomes(make(Dribble, curriculum=WEIGHED, **far), 1, push=0.0)[0][0]
    assert state["reward"].abs().max() < 0.03
    assert state["task_reward"].min() > 0.1


@pytest.mark.parametrize(
    ("task", "curriculum", "name"),
    [
        (Dribble, {"reward_weights": [1.0] * 3}, "reward_weights=[1.0, 1.0, 1.0]"),  # of four terms
        (Carry, {"reward_weights": [1.0] * 5}, "reward_weights=[1.0, 1.0, 1.0, 1.0, 1.0]"),
        (Heading, {"reward_weights": [1.0] * 4}, "reward_weights=[1.0, 1.0, 1.0, 1.0]"),  # of none
        (Dribble, {"reward_weights": WEIGHTS, "success_worth": 0}, "success_worth"),
        (Heading, {"emphasis": None}, "'emphasis'"),
        (Heading, "none", "curriculum='none'"),
    ],
)
def test_a_wrong_curriculum_is_refused(task, curriculum, name):
    refused(lambda: make(task, curriculum=curriculum), name)


def lengths(env, num_steps):
    """Lengths of the episodes that end, by simulation, of a character that stands."""
    env.reset()
    state, ended, last = env.reset(), [[] for _ in range(env.num_envs)], [0] * env.num_envs
    for step in range(1, num_steps + 1):
        outcome, state = env.step_and_maybe_reset(state.set("action", torch.zeros(env.action_spec.shape)))
        for index in outcome["next", "truncated"].flatten().nonzero().flatten().tolist():
            ended[index].append(step - last[index])
            last[index] = step
    return ended


def test_the_first_episodes_are_cut_short_one_by_one_and_the_next_last_as_long_as_they_should():
    env = make(Heading, 4, curriculum={"random_first_length": True}, max_episode_steps=8, terminate_on_fall=False)
    assert lengths(env, 20) == [[8, 8], [6, 8], [4, 8, 8], [2, 8, 8]]
    assert lengths(make(Heading, 4, max_episode_steps=8, terminate_on_fall=False), 20) == [[8, 8]] * 4


def test_only_a_reset_of_all_simulations_shortens_episodes():
    env = make(Heading, 2, curriculum={"random_first_length": True}, max_episode_steps=8)
    env.reset()
    assert env.episode["elapsed_steps"].flatten().tolist() == [0, 4]
    state = env.reset(env.get_state().select("qpos", "qvel"), set_state=True)  # the rest is that of a beginning
    assert env.episode["elapsed_steps"].flatten().tolist() == [0, 0]
    env.episode["elapsed_steps"].fill_(7)  # all episodes end in the next step
    env.step_and_maybe_reset(state.set("action", torch.zeros(env.action_spec.shape)))
    assert env.episode["elapsed_steps"].flatten().tolist() == [0, 0]


def test_a_training_with_shortened_first_episodes_goes_on_at_the_same_moments_after_it_was_interrupted():
    env = make(Heading, 4, curriculum={"random_first_length": True}, max_episode_steps=8)
    env.step(env.reset().set("action", torch.zeros(env.action_spec.shape)))
    saved, elapsed = env.get_extra_state(), env.episode["elapsed_steps"].clone()
    other = make(Heading, 4, curriculum={"random_first_length": True}, max_episode_steps=8)
    other.set_extra_state(saved)
    other.reset()
    assert torch.equal(other.episode["elapsed_steps"], elapsed)


@every_task
def test_a_diverging_simulation_earns_neither(task):
    env = make(task, curriculum=WEIGHED)
    env.reset()
    state = env.get_state()
    state["qvel"][2] = 1e8
    outcome = env.step(env.reset(state, set_state=True).set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert outcome["terminated"][2]
    assert outcome["reward"][2] == outcome["task_reward"][2] == 0
    assert (outcome["task_reward"][:2] > 0).all()
