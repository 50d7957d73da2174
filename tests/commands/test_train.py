import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_module
from hydra.core.hydra_config import HydraConfig

import torchrl_mcp.conf
from torchrl_mcp.commands.train import main
from torchrl_mcp.runs import benchmark

CONF = Path(torchrl_mcp.conf.__file__).parent
PARTS = ("hierarchy",)  # of one method's configuration, which takes both


@pytest.fixture(autouse=True)
def _no_other_test_runs_within_hydra(monkeypatch):
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)


def rounds():
    """Settings that take up every choice of every group, many groups at once, since composing takes long."""
    groups = {folder.name: sorted(file.stem for file in folder.glob("*.yaml")) for folder in CONF.iterdir()}
    groups = {name: found for name, found in groups.items() if found and name not in PARTS}
    for number in range(max(map(len, groups.values()))):
        yield [f"{name}={found[number]}" for name, found in groups.items() if number < len(found)]


@pytest.mark.parametrize("choices", list(rounds()), ids=" ".join)
def test_every_choice_of_every_group_composes(choices):
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        compose("train", choices)


@pytest.mark.parametrize(
    ("task", "curriculum", "mixture"),
    [("holdout", "mixed", 0), ("dribble", "mixed", 3), ("carry", "none", 0)],
)
def test_the_configuration_can_be_printed_with_all_references_resolved(monkeypatch, capsys, task, curriculum, mixture):
    arguments = [f"task={task}", f"curriculum={curriculum}", "stage=transfer", "--cfg", "job", "--resolve"]
    main(arguments)
    printed = yaml.safe_load(capsys.readouterr().out)
    assert len((printed["curriculum"]["aids"] or {}).get("mixture", [])) == mixture
    assert (
        printed["run_dir"] == f"runs/{task}-{printed['character']['name']}/transfer/mcp/curriculum-{curriculum}/seed0"
    )


@pytest.mark.parametrize("words", [["--cfg", "hydra"], ["-c", "hydra"], ["--cfg=hydra"]])
def test_hydras_own_settings_can_be_printed_with_all_references_resolved(monkeypatch, capsys, words):
    main(["run_root=elsewhere", "--resolve", *words])
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed["sweep"]["dir"] == "elsewhere/multirun"
    assert "method" not in printed


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (["method=mpc"], "there is no method=mpc: did you mean mcp? The choices are finetune, hierarchical, "),
        (["mcp"], "mcp is not a setting: write NAME=VALUE without spaces"),
        (["method", "=", "mcp"], "method = mcp is not a setting: write NAME=VALUE without spaces"),
        (["--config-dir", "nowhere", "method=mcp"], "nowhere"),
        (["--config-dir", "nowhere", "benchmark=smoke"], "there is no folder nowhere: correct --config-dir"),
        (["seed=1,2,3"], "seed=1,2,3 has several values: add --multirun"),
        (["seed=range(0,3)"], "seed=range(0,3) has several values: add --multirun"),
        (["hydra/launcher=ray"], "pip install 'torchrl-mcp[ray-launcher]'"),
        (["run_dir=runs/größe"], """without quotes: write 'run_dir="runs/größe"'"""),
        (["run_dir=~/größe"], f"""without quotes: write 'run_dir="{Path.home()}/größe"'"""),
        (["resume=a=b"], """without quotes: write 'resume="a=b"'"""),
        (["sead=3"], "the nearest are: seed"),
        (["method=mcp", "latent_dim=3"], "is not a setting of this method"),
    ],
)
def test_what_hydra_cannot_compose_is_answered_in_a_line(command, tmp_path, arguments, answer):
    outcome = command("train", *arguments, cwd=tmp_path)
    assert outcome.returncode
    assert answer in outcome.stderr
    assert len(outcome.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_options_may_follow_settings_and_a_damaged_file_is_named(command, tmp_path):
    (tmp_path / "own/method").mkdir(parents=True)
    (tmp_path / "own/method/cut.yaml").write_text("defaults: [mcp")
    outcome = command("train", "seed=1", "--config-dir", "own", "method=cut", cwd=tmp_path)
    assert "YAML" in outcome.stderr
    assert "line 1" in outcome.stderr
    assert "Traceback" not in outcome.stderr


def test_the_command_line_of_the_process_stays_and_completion_is_of_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp", "train", "-sc", "install=bash"])
    main(["-sc", "install=bash"])
    assert capsys.readouterr().out.split()[-1] == "torchrl-mcp-train"
    assert sys.argv == ["torchrl-mcp", "train", "-sc", "install=bash"]


def test_without_assertions_the_remedy_is_said(tmp_path):
    words = [sys.executable, "-O", "-m", "torchrl_mcp.commands.train", "--multirun", "seed=range(0,2)"]
    outcome = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert outcome.returncode
    assert outcome.stderr.splitlines()[-1].endswith("unset PYTHONOPTIMIZE, or drop -O")
    assert "Traceback" not in outcome.stderr


@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (["benchmark=mixer", "sead=3"], "seed"),
        (["benchmark=mixr"], "exploration, freeze, mixer"),
        (["benchmark=mixer", "mixer=aditive"], "additive, multiplicative"),
        (["benchmark=mixer", "--cfg", "job"], "--cfg"),
    ],
)
def test_a_mistake_in_a_benchmark_is_answered_with_what_there_is(monkeypatch, capsys, arguments, answer):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code
    said = capsys.readouterr().err + str(stop.value.code)
    assert answer in said
    assert "Traceback" not in said


def test_a_benchmark_of_your_own_is_found(monkeypatch, tmp_path):
    (tmp_path / "own" / "benchmark").mkdir(parents=True)
    (tmp_path / "own" / "benchmark" / "mine.yaml").write_text("rows: [{method: [scratch]}]\nparams: {seed: '4'}\n")
    planned = []
    monkeypatch.setattr(benchmark, "launch", lambda jobs, launcher: planned.extend(jobs) or jobs)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="scratch"):  # what was planned has not been done
        main(["--config-dir", "own", "benchmark=mine"])
    assert [(job.config["method"]["name"], job.config["seed"]) for job in planned] == [("scratch", 4)]
