"""Every method from pre-training to transfer, evaluation and a resumed run, in one iteration or two each."""

import ast
import shutil
from pathlib import Path

import pytest
import smoke
from omegaconf import OmegaConf
from smoke import rows

import torchrl_mcp
from torchrl_mcp import conf
from torchrl_mcp.report.comparison import choices
from torchrl_mcp.report.results import read_run
from torchrl_mcp.runs import build, experiment, policies
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.transfer import fingerprint

ANT = (["task=holdout"], ["task=holdout"])
BIPED = (["task=imitation", "character=biped"], ["task=heading", "character=biped"])


def place(file):
    """Tasks of pre-training and transfer: imitation for a method that has reference motions of its own."""
    return BIPED if "override /motions" in file.read_text() else ANT


FILES = sorted((Path(conf.__file__).parent / "method").glob("*.yaml"))
CASES = {file.stem: (file.stem, place(file)) for file in FILES}
CASES["finetune to the same goal"] = ("finetune", ANT)
CASES["mcp over actions"] = ("mcp", (ANT[0], [*ANT[1], "exploration=action"]))
CASES["latent_space over actions"] = ("latent_space", (ANT[0], [*ANT[1], "exploration=action"]))

SMALL = [
    "training.frames_per_batch=64",
    "training.minibatch_size=64",
    "training.num_epochs=1",
    "training.total_frames=64",
    "action_std=0.1",  # the same noise in both stages
]


def configure(folder, *overrides):
    return smoke.configure(folder, *SMALL, *overrides)


def fingerprints(folder):
    _, agent, _ = policies.restore(folder, num_envs=1, seed=0)
    return {name: fingerprint(part) for name, part in agent.parts.items()}


@pytest.fixture(scope="module", params=CASES)
def runs(request, tmp_path_factory):
    """Run folders of pre-training, or None where there is none, and of transfer."""
    folder, (name, (pretraining, transfer)) = tmp_path_factory.mktemp("runs"), CASES[request.param]
    method = f"method={name}"
    transfer = [method, "stage=transfer", *transfer, "training.total_frames=128", "checkpoint_interval=1"]
    transfer += ["++batch_factor=1", "++steps_per_choice=16"]
    if not configure(folder, *transfer).transfer.keep:
        return None, experiment.train(configure(folder / "transfer", *transfer))
    pretrained = experiment.train(configure(folder / "pretrain", method, "stage=pretrain", *pretraining))
    return pretrained, experiment.train(configure(folder / "transfer", *transfer, f"pretrained={pretrained}"))


@pytest.fixture(scope="module")
def restored(runs):
    """Configuration, agent and environment after transfer."""
    return policies.restore(runs[1], num_envs=1, seed=0)


def test_transfer_begins_with_what_it_keeps_and_changes_all_that_it_does_not_freeze(runs, restored):
    pretrained, _ = runs
    cfg, agent, env = restored
    after = {name: fingerprint(part) for name, part in agent.parts.items()}
    file = checkpoint.find(pretrained) if pretrained else None
    start = {name: fingerprint(part) for name, part in build.make_agent(cfg, env, file).parts.items()}
    if pretrained:
        before = fingerprints(pretrained)
        assert {name for name in start if start[name] == before.get(name)} == set(cfg.transfer.keep)
    assert {name for name in start if start[name] == after[name]} == set(cfg.transfer.freeze)


def test_a_resumed_transfer_continues_to_the_same_numbers(runs, restored, tmp_path):
    _, transferred = runs
    copy = tmp_path / "copy"
    shutil.copytree(transferred, copy)
    checkpoint.find(copy).unlink()
    experiment.resume(copy)
    assert rows(copy) == rows(transferred)
    assert len(rows(copy)) == 2
    assert fingerprints(copy) == {name: fingerprint(part) for name, part in restored[1].parts.items()}


def test_a_checkpoint_is_evaluated_with_and_without_exploration(runs, restored):
    results = policies.evaluation(runs[1], episodes=3, seed=0, max_episode_steps=5)
    for numbers in (results["deterministic"], results["stochastic"]):
        assert 1 <= numbers["length"] <= 5
        assert 0 < numbers["return"] == pytest.approx(numbers["return"])
    assert results["deterministic"]["return"] != results["stochastic"]["return"]
    agent, found = restored[1], results["stochastic"]["diagnostics"]
    for key, name in {"gates": "gates/effective_primitives", "begins": "options/effective_options"}.items():
        assert (name in found) == (key in agent.actor.stored)
        assert 1 <= found.get(name, 1) <= 8 + 1e-4


def test_before_an_update_the_loss_sees_the_policy_that_collected(runs):
    # One gradient step per iteration: its report is from before the step. Other batch sizes round differently.
    tolerance = 1e-5
    for folder in filter(None, runs):
        for row in rows(folder):
            if "loss/kl" not in row:
                continue  # a frozen actor has no ratio
            assert float(row["loss/clip_fraction"]) == 0
            assert abs(float(row["loss/max_ratio"]) - 1) <= tolerance
            assert abs(float(row["loss/kl_approx"])) <= tolerance
            assert float(row["loss/ESS"]) == pytest.approx(1, abs=tolerance)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_method_tells_its_name_its_title_and_the_settings_by_which_it_is_known(file, tmp_path):
    cfg = configure(tmp_path, f"method={file.stem}", "stage=transfer", "task=heading", "character=biped")
    others = [other for other in FILES if other != file]
    assert cfg.method.name == file.stem
    assert f"title: {cfg.method.title}\n" in file.read_text()
    assert not any(f"title: {cfg.method.title}\n" in other.read_text() for other in others)
    OmegaConf.save(cfg, tmp_path / "config.yaml", resolve=True)
    run = read_run(tmp_path)
    assert {name: choices(run)[name] for name in run.standard} == run.standard


def test_the_library_chooses_nothing_by_the_name_of_a_method():
    spoken = {
        "paper.py",
        "table_2.py",
        "builtin.py",
        "demo.py",
    }  # Table 2, the networks that come along, MCP and scratch
    names = {file.stem for file in FILES}
    for path in Path(torchrl_mcp.__file__).parent.rglob("*.py"):
        literals = {node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)}
        assert path.name in spoken or not literals & names, path
