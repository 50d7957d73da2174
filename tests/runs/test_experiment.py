"""The command line: what it runs, what it refuses and what it says instead."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from refusals import contents, refused
from smoke import SMOKE
from torch import nn

from torchrl_mcp import conf
from torchrl_mcp.commands import evaluate, train
from torchrl_mcp.runs import benchmark, build, experiment, policies, records
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training.checkpoint import run_checkpoint
from torchrl_mcp.training.update import Agent

LENGTHS = ["task.evaluation.max_episode_steps=40", "task.pretrain.max_episode_steps=30"]
CONFIGS = sorted(Path(conf.__file__).parent.rglob("*.yaml"))


@pytest.fixture(scope="module")
def run(command, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    assert command("train", *SMOKE, *LENGTHS, cwd=folder).returncode == 0
    name = "_".join(["preset-smoke", *LENGTHS]).replace("=", "-")
    return folder / f"runs/holdout-ant/pretrain/mcp/{name}/seed0"


def test_a_run_leaves_one_folder_with_configuration_metrics_and_checkpoints(run):
    root = run.parents[5]
    assert {path.name for path in root.iterdir()} == {"runs"}
    assert {path.name for path in run.iterdir()} == {"config.yaml", "origin.json", "metrics.csv", "checkpoints"}
    assert OmegaConf.load(run / "config.yaml").method.name == "mcp"
    origin = json.loads((run / "origin.json").read_text())
    assert origin["command"] == ["torchrl-mcp-train", *SMOKE, *LENGTHS]
    assert origin["choices"]["preset"] == "smoke"
    assert "hydra/launcher" not in origin["choices"]


def test_a_multirun_makes_a_folder_per_job(command, tmp_path):
    outcome = command("train", "-m", *SMOKE, "mixer=multiplicative,additive", "training.total_frames=128", cwd=tmp_path)
    assert outcome.returncode == 0, outcome.stderr
    assert len(list(tmp_path.rglob("metrics.csv"))) == 2


def test_evaluation_reports_as_many_episodes_as_asked_and_writes_them_down(command, run, tmp_path):
    outcome = command("evaluate", run, "--episodes", 20, "--output", tmp_path / "numbers.json", cwd=tmp_path)
    assert outcome.returncode == 0, outcome.stderr
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    for mode in ("deterministic", "stochastic"):
        assert numbers[mode]["episodes"] == 20
        assert f"normalised return {numbers[mode]['normalised_return']:.3f}" in outcome.stdout
        # Holdout normalises by 6 per step, evaluated over 40 steps, though this run was trained on 30.
        assert numbers[mode]["normalised_return"] == pytest.approx(numbers[mode]["return"] / (6 * 40), rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["stage=transfer"], ["pretrained=<folder>"]),
        (["stage=transfer", "pretrained=nowhere"], ["nowhere"]),
        (["exploration=weights"], ["stage=transfer"]),
        (["resume=nowhere", "device=cuda"], ["preset=smoke"]),
        (["training.minibatch_size=100"], ["minibatch_size=100"]),
        (["num_primitives=0"], ["num_primitives=0"]),
        (["stage=transfer", "num_primitives=4", "pretrained={run}"], ["num_primitives=8", "num_primitives=4"]),
        (
            [*["task=heading", "character=humanoid", "method=moe", "stage=transfer", "pretrained=builtin:biped"]],
            ["method=mcp", "character=biped", "method=moe", "character=humanoid"],
        ),
    ],
    ids=lambda value: " ".join(value),
)
def test_a_mistake_is_answered_without_a_traceback_and_nothing_is_written(command, run, tmp_path, arguments, names):
    outcome = command("train", *SMOKE, *(word.format(run=run) for word in arguments), cwd=tmp_path)
    assert outcome.returncode != 0
    assert all(name in outcome.stderr for name in names), outcome.stderr
    assert "Traceback" not in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_second_run_in_the_same_folder_is_refused_and_leaves_it_untouched(command, run):
    before = contents(run)
    same = command("train", *SMOKE, *LENGTHS, f"run_dir={run}", cwd=run.parents[5])
    other = command("train", *SMOKE, LENGTHS[0], f"run_dir={run}", cwd=run.parents[5])
    assert same.returncode != 0 != other.returncode
    assert f"continue it with torchrl-mcp-train resume={run}" in same.stderr
    assert "differs in task" in other.stderr
    assert contents(run) == before


def test_a_folder_with_checkpoints_of_a_run_without_its_configuration_is_refused(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (copy / "config.yaml").unlink()
    cfg = compose_run(*SMOKE, f"run_dir={copy}")
    refused(lambda: experiment.train(cfg), str(copy), "config.yaml", untouched=copy)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_run_of_a_gpu_goes_on_without_one_if_told_to(run, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    cfg = OmegaConf.load(copy / "config.yaml")
    cfg.device, cfg.training.total_frames = "cuda", 2 * cfg.training.total_frames
    OmegaConf.save(cfg, copy / "config.yaml")
    refused(lambda: experiment.resume(copy), "device=cuda", untouched=copy)
    experiment.resume(copy, device="cpu")
    assert records.is_complete(copy)


def flip_a_byte(data):
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 0xFF]) + data[len(data) // 2 + 1 :]


@pytest.mark.parametrize("damage", [flip_a_byte, lambda data: data[:1000], lambda data: b"something else"])
def test_damage_of_all_checkpoints_stops_a_resume_and_leaves_the_run_folder_untouched(command, run, tmp_path, damage):
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    for file in (copy / "checkpoints").iterdir():
        file.write_bytes(damage(file.read_bytes()))
    cfg = OmegaConf.load(copy / "config.yaml")
    cfg.training.total_frames *= 2  # there is something left to do
    OmegaConf.save(cfg, copy / "config.yaml")
    before = contents(copy)
    outcome = command("train", f"resume={copy}", cwd=tmp_path)
    assert outcome.returncode != 0
    assert "damaged" in outcome.stderr
    assert contents(copy) == before


def test_a_resume_of_no_run_is_refused(command, tmp_path):
    outcome = command("train", "resume=nowhere", cwd=tmp_path)
    assert outcome.returncode != 0
    assert "nowhere" in outcome.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_complete_run_is_left_as_it_is_and_said_to_be_complete(run, monkeypatch, capsys):
    before = contents(run)
    monkeypatch.setattr(sys, "argv", ["train", f"resume={run}"])
    train.main()
    assert f"{run} is complete" in capsys.readouterr().out
    assert contents(run) == before


@pytest.fixture(scope="module")
def evaluated(run, tmp_path_factory):
    """The run, resumed after its configuration asked for an evaluation."""
    copy = tmp_path_factory.mktemp("evaluated") / "run"
    shutil.copytree(run, copy)
    cfg = OmegaConf.load(copy / "config.yaml")
    cfg.evaluation.episodes = 3
    OmegaConf.save(cfg, copy / "config.yaml")
    assert not records.is_complete(copy)
    experiment.resume(copy)
    return copy


def test_training_ends_with_an_evaluation_also_after_a_resume(evaluated):
    assert records.is_complete(evaluated)
    written = json.loads((evaluated / "evaluation.json").read_text())
    assert (written["episodes"], written["seed"]) == (3, 12345)
    assert written["environment"]["max_episode_steps"] == 40  # of the task, where training had 30
    for mode in ("deterministic", "stochastic"):
        assert written[mode]["episodes"] == 3
        assert "gates/entropy" in written[mode]["diagnostics"]


def test_the_evaluate_command_writes_what_training_writes(evaluated, monkeypatch, capsys):
    written = (evaluated / "evaluation.json").read_text()
    output = evaluated / "again.json"
    monkeypatch.setattr(sys, "argv", ["evaluate", str(evaluated), "--episodes", "3", "--output", str(output)])
    evaluate.main()
    assert output.read_text() == written


def test_a_run_that_is_to_go_on_loses_its_evaluation_and_gets_another(evaluated, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(evaluated, copy)
    cfg = OmegaConf.load(copy / "config.yaml")
    cfg.training.total_frames *= 2
    OmegaConf.save(cfg, copy / "config.yaml")
    assert not records.is_complete(copy)
    experiment.resume(copy)
    assert records.is_complete(copy)
    assert (copy / "evaluation.json").read_text() != (evaluated / "evaluation.json").read_text()


def of_another_version(evaluated, folder):
    """A copy of the run as a version wrote it that had another name for a function, and one of its checkpoints."""
    shutil.copytree(evaluated, folder)
    cfg = OmegaConf.load(folder / "config.yaml")
    cfg.parts["_target_"] = "torchrl_mcp.actors.composite_parts"
    OmegaConf.save(cfg, folder / "config.yaml")
    config = OmegaConf.to_container(cfg)
    file = folder / "old.torchrl"
    run_checkpoint(nn.ModuleDict({"policy": nn.Linear(1, 1)})).save(file, metadata={"config": config})
    return folder, file


def test_a_run_of_another_version_is_refused_with_the_name_it_misses_and_the_remedy(evaluated, tmp_path):
    folder, file = of_another_version(evaluated, tmp_path / "run")
    readers = [
        (folder / "config.yaml", lambda: experiment.resume(folder)),
        (folder / "config.yaml", lambda: records.is_complete(folder)),
        (file, lambda: policies.restore(file, num_envs=1, seed=0)),
        (file, lambda: policies.evaluation(file, episodes=1, seed=0)),
        (folder / "config.yaml", lambda: benchmark.conflict(benchmark.Job(folder, [], {}))),
    ]
    for source, read in readers:
        refused(read, str(source), "torchrl_mcp.actors.composite_parts", untouched=folder)


def test_all_imitation_is_evaluated_in_episodes_of_the_same_length():
    found = {}
    for method in ("mcp", "finetune", "hierarchical"):
        evaluation = compose_run("task=imitation", f"method={method}", "preset=fast").evaluation
        assert (evaluation.episodes, evaluation.seed) == (128, 12345)
        found[method] = OmegaConf.to_container(evaluation.environment, resolve=True)
    assert (found["mcp"]["clip_end"], found["mcp"]["switch_interval"]) == ("switch", 5.0)
    for method in ("finetune", "hierarchical"):  # of policies that cannot see what they follow
        assert found[method] == {**found["mcp"], "switch_to": "same"}


@pytest.mark.parametrize("method", ["mcp", "moe", "latent_space", "finetune", "hierarchical", "option_critic"])
def test_fast_imitation_has_shorter_returns_than_tasks(method):
    overrides = ("preset=comparison", f"method={method}", "character=biped")
    imitation = compose_run(*overrides, "task=imitation").objective.advantages.lmbda
    transfer = compose_run(*overrides, "task=heading", "stage=transfer").objective.advantages.lmbda
    assert (imitation, transfer) == ((0.5, 0.5) if method == "option_critic" else (0.8, 0.95))


@pytest.mark.parametrize(
    ("method", "candidates"), [("mcp", 1), ("moe", 1), ("option_critic", 1), ("finetune", 16), ("hierarchical", 16)]
)
def test_only_methods_that_see_their_reference_imitate_changes_to_any_moment(method, candidates):
    cfg = compose_run("task=imitation", f"method={method}", "num_threads=1")
    assert build.make_env(cfg, num_envs=1, seed=0).switch_candidates == candidates


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: "/".join(path.parts[-2:]))
def test_every_configuration_file_is_short_and_says_what_it_is(path):
    lines = path.read_text().splitlines()
    assert any(line.startswith("# ") and not line.startswith("# @package") for line in lines[:2])
    assert path.name == "train.yaml" or len(lines) <= {"method": 30, "preset": 25, "task": 50, "conf": 50}.get(
        path.parent.name, 20
    )


def test_the_rehearsal_of_the_evaluation_uses_up_no_random_numbers_of_a_gpu(tmp_path, monkeypatch):
    cfg = compose_run(*SMOKE, *LENGTHS, f"run_dir={tmp_path}/run", "evaluation.episodes=2")
    trainer = build.make_run(cfg, tmp_path / "run")
    generator = {"drawn": torch.tensor(7)}  # stands for the GPU's
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device: generator["drawn"].clone())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device: generator.update(drawn=state))
    monkeypatch.setattr(Agent, "device", property(lambda agent: torch.device("cuda")))
    real = experiment.evaluate

    def evaluate_on_gpu(policy, env, *, max_steps, device):
        assert device.type == "cuda"
        generator["drawn"] += 1
        return real(policy, env, max_steps=max_steps, device="cpu")

    monkeypatch.setattr(experiment, "evaluate", evaluate_on_gpu)
    before = torch.get_rng_state()
    experiment._rehearse(trainer, cfg)
    assert generator["drawn"] == 7
    assert torch.equal(torch.get_rng_state(), before)
