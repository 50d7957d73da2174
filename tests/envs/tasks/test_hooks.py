"""What a task says of a step changes nothing, and what changes is said where a step is made."""

from itertools import pairwise

import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, Location
from torchrl_mcp.envs.motions.single import single_motion

TERMS = {"bodies": {"weight": 0.5, "scale": 50.0}, "velocity": {"weight": 0.5, "scale": 0.2}}
WEIGHTS = {"reward_weights": [1.0, 0.2, 1.0, 2.0]}
MAKERS = {
    "heading": lambda **more: Heading("biped", **more),
    "speeds": lambda **more: Heading("biped", speed=(0.0, 1.5), **more),
    "location": lambda **more: Location("biped", final_directions=(-1.0, 1.0), **more),
    "carry": lambda **more: Carry("biped", curriculum=WEIGHTS, success_reward=True, **more),
    "dribble": lambda **more: Dribble("biped", curriculum=WEIGHTS, success_reward=True, **more),
    "holdout": lambda **more: Holdout(directions=(0.0, 1.0), contact_forces=True, **more),
    "imitation": lambda **more: Imitation("biped", single_motion("biped"), terms=TERMS, **more),
}


@pytest.mark.parametrize("task", MAKERS)
def test_observations_rewards_and_ends_of_a_step_can_be_asked_for_any_number_of_times(task):
    env = MAKERS[task](num_envs=3, seed=0, num_threads=1)
    state = env.reset()
    for _ in range(3):
        state = env.step(state.set("action", torch.full(env.action_spec.shape, 0.1)))["next"].exclude("reward")
    before, generator = env.get_state(), env.generator.get_state()
    hooks = [env.reward, env.terminated, env.truncated, lambda: torch.cat([*env.observe(slice(None)).values()], -1)]
    hooks += [env.training_reward] if task in ("carry", "dribble") else []
    for hook in hooks:
        assert torch.equal(hook(), hook())
    after = env.get_state()
    assert all(torch.equal(before[key], after[key]) for key in before.keys())  # noqa: SIM118 (of a TensorDict)
    assert torch.equal(env.generator.get_state(), generator)


def test_a_tracked_place_has_the_velocity_of_the_last_step():
    velocities = []

    class Watched(Heading):
        def reward(self):
            velocities.append(self.velocity("com").clone())
            return super().reward()

    env = Watched("biped", num_envs=2, seed=0, num_threads=1)
    state, places = env.reset(), [env.com.clone()]
    for _ in range(4):
        state = env.step(state.set("action", torch.full(env.action_spec.shape, 0.3)))["next"].exclude("reward")
        places.append(env.com.clone())
    for velocity, (before, after) in zip(velocities, pairwise(places), strict=True):
        torch.testing.assert_close(velocity, (after - before) * 30)


@pytest.mark.parametrize("task", ["heading", "location", "carry", "dribble"])
def test_by_default_the_best_normalised_return_is_a_reward_of_1_in_every_step(task):
    env = MAKERS[task](num_envs=1, max_episode_steps=40)
    assert env.normalised_return(torch.tensor([0.0, 40.0])).tolist() == [0.0, 1.0]
