"""What CONTRIBUTING says about additions is enough: files of one's own, outside the library, and no other."""

import json
import re
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from omegaconf import OmegaConf
from smoke import rows

from torchrl_mcp.runs import build, policies, records
from torchrl_mcp.runs.trust import trusting
from torchrl_mcp.training import checkpoint

CONTRIBUTING = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text()
TINY = "preset=smoke logger=none num_threads=1 torch_threads=1 progress_bar=false checkpoint_interval=1"


class Addition(NamedTuple):
    """Files of a user's own, by their places in the working directory, and the settings that choose them."""

    files: dict[str, str]
    settings: str
    name: str
    """What the path of the run folder must contain."""

    @property
    def module(self):
        return next(file for file in self.files if file.endswith(".py")).removesuffix(".py")


ADDITIONS = {
    "mixer": Addition(
        {
            "own_mixer.py": """
from torch.distributions import Independent, Normal

class AverageGaussian(Independent):
    def __init__(self, loc, scale, gates, validate_args=None):
        share = (gates / gates.sum(-1, keepdim=True)).unsqueeze(-1)
        super().__init__(Normal((share * loc).sum(-2), (share * scale).sum(-2)), 1, validate_args)

    @property
    def deterministic_sample(self):
        return self.mean
""",
            "own/mixer/average.yaml": """
name: average
distribution_class: {_target_: hydra.utils.get_class, path: own_mixer.AverageGaussian}
""",
        },
        "method=mcp task=holdout mixer=average num_primitives=3",
        "mixer-average_",
    ),
    "physics engine": Addition(
        {
            "own_engine.py": """
from copy import copy

from torchrl_mcp.envs.physics.engines import mujoco_threads

def moon(model, num_envs, **settings):
    model = copy(model)
    model.opt.gravity[2] = -1.62
    return mujoco_threads(model, num_envs, **settings)
""",
            "own/physics/moon.yaml": "engine: {_target_: own_engine.moon, _partial_: true}\non_device: false\n",
        },
        "method=scratch task=holdout physics=moon",
        "physics-moon_",
    ),
    "task": Addition(
        {
            "own_task.py": """
import torch

from torchrl_mcp.envs import PDCharacterEnv

class Wait(PDCharacterEnv):
    def __init__(self, character, num_envs, *, worth, max_episode_steps=20, **kwargs):
        self.worth = worth
        super().__init__(character, num_envs, max_episode_steps=max_episode_steps, **kwargs)
        self.make_specs()

    def observe(self, ids):
        state, _ = self.see(ids)
        return {"observation": state, "goal": torch.zeros(len(state), 1)}

    def reward(self):
        return torch.full((self.num_envs,), self.worth, dtype=torch.float64)
""",
            "own/task/wait.yaml": """
defaults: [override /character@_global_.character: biped]
name: wait
goal: new
evaluation: {worth: 0.5}
transfer: {_target_: own_task.Wait, _partial_: true, character: "${character.name}", worth: 0.25}
""",
            "own/tuned/wait/scratch.yaml": "# @package _global_\nlmbda: 0.5\n",
        },
        "method=scratch task=wait",
        "wait-biped/transfer/scratch/",
    ),
    "method": Addition(
        {
            "own_method.py": """
from torch import nn

from torchrl_mcp.methods.actor import input_normalisers

class Linear(nn.Module):
    def __init__(self, observation_dim, action_dim, std):
        super().__init__()
        self.loc, self.std = nn.Linear(observation_dim, action_dim), std

    def forward(self, observation, goal):
        loc = self.loc(observation)
        return loc, loc.new_full(loc.shape, self.std)

def linear_parts(sizes, *, std):
    parts = nn.ModuleDict(input_normalisers(sizes))
    parts["policy"] = Linear(sizes.observation, sizes.action, std)
    return parts
""",
            "own/method/linear.yaml": """
# @package _global_
defaults: [override /stage: transfer]
method: {name: linear, title: Linear}
parts: {_target_: own_method.linear_parts, _partial_: true, std: "${action_std}"}
actor: {_target_: torchrl_mcp.methods.scratch.gaussian_actor, _partial_: true}
transfer: {keep: [], freeze: []}
""",
        },
        "method=linear task=holdout",
        "holdout-ant/transfer/linear/",
    ),
}


@pytest.fixture(scope="module", params=ADDITIONS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def run(kind, command, tmp_path_factory):
    """The run folder of a training with an addition, and what the command printed."""
    folder, addition = tmp_path_factory.mktemp("own"), ADDITIONS[kind]
    for name, content in addition.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content.lstrip())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path])  # commands append their working directory
        outcome = command(
            "train",
            "--config-dir",
            "own",
            *addition.settings.split(),
            *TINY.split(),
            "evaluation.episodes=2",
            "++task.evaluation.max_episode_steps=20",
            cwd=folder,
        )
        assert outcome.returncode == 0, outcome.stderr
        yield next(folder.rglob("config.yaml")).parent
    sys.modules.pop(addition.module)


@pytest.fixture
def again(kind, command, run):
    """Call a command that reads the run, from the folder of the addition."""
    root = next(parent for parent in run.parents if parent.name == "runs").parent

    def call(name, *words):
        outcome = command(name, "--trust", ADDITIONS[kind].module, *words, cwd=root)
        assert outcome.returncode == 0, outcome.stderr
        return outcome.stdout

    return call


def restored(kind, run):
    with trusting({ADDITIONS[kind].module}):
        return policies.restore(run, num_envs=3, seed=0)


def test_contributing_names_the_places_of_its_files(kind):
    paragraph = re.search(rf"^\*\*{kind}\*\*:.*?\n\n", CONTRIBUTING, re.DOTALL | re.MULTILINE).group()
    for file in ADDITIONS[kind].files:
        if file.endswith(".yaml"):
            assert f"`conf/{Path(file).parts[1]}/" in paragraph


def test_its_run_has_a_folder_with_its_name_its_settings_and_an_evaluation(kind, run):
    addition = ADDITIONS[kind]
    assert addition.name in str(run)
    assert f"{addition.module}." in (run / "config.yaml").read_text()
    assert len(rows(run)) == 4
    results = json.loads((run / "evaluation.json").read_text())
    assert -10 < results["deterministic"]["normalised_return"] < 10


def test_its_run_is_evaluated_again_to_the_same_numbers(run, again, tmp_path):
    written = json.loads((run / "evaluation.json").read_text())
    again("evaluate", run, "--episodes", 2, "--output", tmp_path / "numbers.json")
    assert json.loads((tmp_path / "numbers.json").read_text()) == written


def test_its_run_resumes_to_the_same_numbers(run, again):
    before = rows(run), json.loads((run / "evaluation.json").read_text())
    checkpoint.find(run).unlink()
    assert "continues" in again("train", f"resume={run}")
    assert (rows(run), json.loads((run / "evaluation.json").read_text())) == before


def only(kind):
    return pytest.mark.parametrize("kind", [kind], indirect=True)


@only("mixer")
def test_the_mixer_composes_the_primitives(kind, run):
    _, agent, env = restored(kind, run)
    seen = env.rollout(4, agent.actor.policy)
    share = seen["gates"] / seen["gates"].sum(-1, keepdim=True)
    expected = torch.einsum("...k,...ka->...a", share, seen["primitives", "loc"])
    torch.testing.assert_close(agent.actor.trained.get_dist(seen).mean, expected)


@only("physics engine")
def test_the_engine_simulates_training_and_mujoco_the_evaluation(kind, run):
    with trusting({ADDITIONS[kind].module}):
        trained = build.make_source(records.run_config(run)).env
    _, _, evaluated = restored(kind, run)
    assert [env.simulation.model.opt.gravity[2] for env in (trained, evaluated)] == [-1.62, -9.81]


@only("task")
def test_the_task_rewards_training_and_evaluation_and_its_method_is_tuned(run):
    assert {float(row["reward"]) for row in rows(run)} == {0.25}
    assert json.loads((run / "evaluation.json").read_text())["deterministic"]["return"] == 0.5 * 20
    assert OmegaConf.load(run / "config.yaml").objective.advantages.lmbda == 0.5


@only("method")
def test_the_method_acts_by_its_network(kind, run):
    _, agent, env = restored(kind, run)
    seen = env.rollout(4, agent.actor.policy)
    layer = agent.parts["policy"].loc
    expected = seen["normalised", "observation"] @ layer.weight.T + layer.bias
    torch.testing.assert_close(agent.actor.trained.get_dist(seen).mean, expected)
