"""Evaluations are alike, whatever was used in training."""

from functools import cache

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_mcp.evaluation.rollout import evaluate
from torchrl_mcp.runs import arguments as called
from torchrl_mcp.runs import build, policies
from torchrl_mcp.runs.configuration import compose_run

STAGES = {
    "holdout": "pretrain",
    "imitation": "pretrain",
    "heading": "transfer",
    "location": "transfer",
    "carry": "transfer",
    "dribble": "transfer",
}
NO_SETTINGS = {
    "self",
    "character",
    "num_envs",
    "clips",
    "motions",
    "seed",
    "num_threads",
    "physics",  # evaluations are always of MuJoCo on the CPU
    "device",
    "dtype",
    "pin_memory",
    "kwargs",
}
"""Arguments that every maker of an environment gives, or that say what is in it and not what happens."""
RUNS_OWN = {
    "imitation": {"terms", "switch_to"},
    "heading": {"speed", "waypoint"},
    "location": {"final_directions"},
    "carry": {"goal_positions", "waypoint"},
    "dribble": {"goal_positions", "waypoint"},
}
"""What an evaluation takes from training, as its file says: the reward, and what policies can follow and see."""
CURRICULUM = {
    "initial_states": {"rest": 0.0, "motions": 1.0},
    "mixture": [{"weight": 2.0}],
    "reward_weights": [0.6, 0.1, 1.0, 0.5],
    "random_first_length": True,
}
WORDS = {
    "curriculum": CURRICULUM,
    "max_episode_steps": 7,
    "physics_timestep": 1 / 240,
    "friction_cone": "elliptic",
    "clip_end": "truncate",
    "goal_positions": "metres",
    "target_distance_power": 1,
}


def another(name, value):
    """Return another value of a setting than that of the evaluation."""
    if name in WORDS:
        return WORDS[name]
    if isinstance(value, bool):
        return not value
    if isinstance(value, list):
        return [bound + 0.05 for bound in value]
    return 2 * value + 1


every_task = pytest.mark.parametrize("task", STAGES)


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs divergence in the working directory


def configure(task, *overrides):
    return compose_run(f"task={task}", f"stage={STAGES[task]}", "num_threads=1", *overrides)


@cache
def usual(task):
    """The configuration of a task, which nobody changes."""
    return configure(task)


def evaluated_as(cfg):
    """Arguments of the evaluation's environment."""
    return OmegaConf.to_container(cfg.evaluation.environment, resolve=True)


def trained_otherwise(task):
    """A configuration in which every setting of the training's environment has another value."""
    cfg, place = configure(task), "imitation" if task == "imitation" else f"task.{STAGES[task]}"
    for name, value in evaluated_as(cfg).items():
        if name not in RUNS_OWN.get(task, set()):
            OmegaConf.update(cfg, f"{place}.{name}", another(name, value), merge=False, force_add=True)
    if task in ("heading", "location"):  # whose reward has no terms to weigh
        cfg.task.transfer.curriculum.reward_weights = None
    return cfg


@every_task
def test_an_evaluation_says_every_setting_of_its_environment(task):
    cfg = usual(task)
    arguments = called.arguments(cfg.task[STAGES[task]]._target_)
    inside = {
        "furnish",
        "episode",
        "model",
        "substeps",
        "outputs",
        "model_fields",
    }
    if task == "imitation":  # whose episodes begin in the middle of motions
        inside.add("curriculum")
    settings = arguments.keys() - NO_SETTINGS - inside - {"persistent", "current"}
    assert evaluated_as(cfg).keys() == settings


@every_task
def test_evaluations_are_equal_whatever_was_used_in_training(task):
    plain, other = usual(task), trained_otherwise(task)
    assert evaluated_as(plain) == evaluated_as(other)
    outcomes = []
    for cfg in (plain, other):
        env = build.make_env(cfg, num_envs=3, seed=0, **{**evaluated_as(cfg), "max_episode_steps": 20})
        outcomes.append(evaluate(Push(env), env, positions=env.root_positions))
    one, two = outcomes
    for name in ("returns", "lengths", "terminated", "positions"):
        assert torch.equal(getattr(one, name).nan_to_num(-9), getattr(two, name).nan_to_num(-9)), name
    assert one.metrics.keys() == two.metrics.keys()
    for name, values in one.metrics.items():
        assert torch.equal(values, two.metrics[name]), name


@every_task
def test_what_training_uses_would_make_another_evaluation(task):
    cfg = trained_otherwise(task)
    trained = OmegaConf.to_container(cfg.task[STAGES[task]], resolve=True)
    for name, value in evaluated_as(cfg).items():
        if name not in RUNS_OWN.get(task, set()):
            assert trained[name] != value, name


@pytest.mark.parametrize("character", ["humanoid", "trex"])
@pytest.mark.parametrize("task", ["carry", "dribble"])
def test_near_objects_of_training_are_clear_of_every_character(task, character):
    cfg = configure(task, f"character={character}", "curriculum=mixed")
    build.make_env(cfg, num_envs=2, seed=0).reset()


@pytest.mark.parametrize("curriculum", ["none", "mixed"])
@pytest.mark.parametrize("task", ["heading", "location", "carry", "dribble"])
def test_every_curriculum_makes_environments_that_begin_and_are_evaluated_alike(task, curriculum):
    cfg = configure(task, f"curriculum={curriculum}")
    assert evaluated_as(cfg) == evaluated_as(usual(task))
    env = build.make_env(cfg, num_envs=2, seed=0, max_episode_steps=3)
    another = curriculum == "mixed" and task in ("carry", "dribble")
    assert ("task_reward" in env.rollout(2)["next"]) == another


class Push(torch.nn.Module):
    """A policy that gives the same action at all times."""

    def __init__(self, env):
        super().__init__()
        self.action = torch.full(env.action_spec.shape, 0.1)
        self.in_keys = ["observation"]

    def forward(self, seen):
        return seen.set("action", self.action)


def test_single_clips_are_followed_by_the_rules_of_evaluations(monkeypatch):
    class Restored(Exception):
        pass

    def restore(_, **arguments):
        raise Restored(arguments)

    monkeypatch.setattr(policies, "restore", restore)
    monkeypatch.setattr(policies, "policy_config", lambda _: compose_run("task=imitation", "+imitation.max_error=0.5"))
    with pytest.raises(Restored) as restored:
        policies.evaluate_clips("run", episodes=1, seed=0, max_episode_steps=30)
    (arguments,) = restored.value.args
    assert (arguments["max_error"], arguments["terminate_on_fall"], arguments["max_episode_steps"]) == (0.3, True, 30)
