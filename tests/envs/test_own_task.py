"""A task of one's own: what the base class does for it, and mistakes that it names."""

import pytest
import torch
from refusals import refused
from tensordict import TensorDict

from torchrl_mcp.envs import Carry, Heading, Holdout, Location, PDCharacterEnv
from torchrl_mcp.envs.motions.single import single_motion


class Stand(PDCharacterEnv):
    """Nothing to do."""

    def __init__(self, num_envs=3, *, finished=True, **kwargs):
        super().__init__("biped", num_envs, max_episode_steps=10, seed=0, num_threads=1, **kwargs)
        if finished:
            self.make_specs()

    def observe(self, ids):
        return {"observation": self.see(ids)[0], "goal": self.com[ids, :0]}

    def reward(self):
        return torch.ones(self.num_envs, dtype=torch.float64)


def step(env):
    return env.step(env.reset().set("action", torch.zeros(env.action_spec.shape)))["next"]


def test_a_curriculum_lets_its_episodes_begin_in_motion():
    moving = Stand(curriculum={"initial_states": "motions", "motions": single_motion("biped")})
    moving.reset()
    assert (moving.get_state()["qvel"].norm(dim=-1) > 0.5).all()
    resting = Stand()
    resting.reset()
    assert not resting.get_state()["qvel"].any()


@pytest.mark.parametrize(
    ("curriculum", "name"),
    [({"initial_states": "nonsense"}, "initial_states='nonsense'"), ({"mixture": [{"weight": 1.0}]}, "mixture")],
)
def test_a_curriculum_without_effect_is_refused(curriculum, name):
    refused(lambda: Stand(curriculum=curriculum), name)


@pytest.mark.parametrize("method", ["reward", "terminated", "truncated"])
def test_a_reward_or_an_end_of_another_shape_is_named(method):
    wrong = type("Wrong", (Stand,), {method: lambda self: torch.zeros(self.num_envs, 1, dtype=torch.bool)})
    refused(lambda: step(wrong()), f"Wrong.{method}()", "(3, 1)", "(3,)")


def test_an_end_that_the_task_stores_stays_in_the_step_that_it_ended():
    class Ends(Holdout):
        ended = torch.zeros(2, dtype=torch.bool)

        def initial_state(self, num):
            self.ended[:] = False
            return super().initial_state(num)

        def after_step(self, diverged):
            self.ended[:] = True

        def terminated(self):
            return self.ended

    env = Ends(num_envs=2, directions=(0.0, 1.0), seed=0, num_threads=1)
    outcome, _ = env.step_and_maybe_reset(env.reset().set("action", torch.zeros(env.action_spec.shape)))
    assert outcome["next", "terminated"].all()
    assert not env.ended.any()  # the next episodes have begun


@pytest.mark.parametrize(
    ("extra", "name"), [({"observation": None}, "observation"), ({"close": torch.zeros(3)}, "close")]
)
def test_observations_of_another_shape_and_missing_ones_are_named(extra, name):
    def observe(self, ids):
        return {key: value for key, value in (Stand.observe(self, ids) | extra).items() if value is not None}

    refused(type("Wrong", (Stand,), {"observe": observe}), "Wrong.observe()", name)


def test_a_metric_of_several_numbers_has_a_name_for_each():
    def observe(self, ids):
        return Stand.observe(self, ids) | {"contacts": self.com[ids], "close": self.com[ids, :1] < 1}

    env = type("Touching", (Stand,), {"observe": observe})()
    assert env.metric_names == {"contacts": ["contacts_0", "contacts_1", "contacts_2"], "close": ["close"]}


def test_forgotten_specs_are_named():
    refused(lambda: Stand(finished=False).reset(), "Stand", "make_specs()", error=RuntimeError)


@pytest.mark.parametrize("task", [Carry, Heading, Location])
def test_a_reset_of_no_simulation_changes_nothing(task):
    env = task("biped", 2, seed=0, num_threads=1)
    before = env.reset()
    after = env.reset(TensorDict({**before, "_reset": torch.zeros(2, 1, dtype=torch.bool)}, [2]))
    assert all(torch.equal(after[key], before[key]) for key in ("observation", "goal", "done"))
