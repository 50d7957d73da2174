"""What this machine or the command line lacks is said before a folder exists."""

import re
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from torchrl_mcp import conf
from torchrl_mcp.runs import build, experiment, requirements
from torchrl_mcp.runs.configuration import compose_run

HEADING = ["task=heading", "character=humanoid"]


def configure(folder, *overrides):
    return compose_run("preset=smoke", "logger=none", f"run_dir={folder / 'run'}", *overrides)


@pytest.mark.parametrize("kind", ["wandb", "mlflow"])
def test_a_logger_that_is_not_installed_is_named_with_what_installs_it(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(requirements, "find_spec", lambda name: None if name == kind else find_spec(name))
    with pytest.raises(ValueError, match=rf"logger={kind} needs {kind}: pip install 'torchrl-mcp\[{kind}\]'"):
        experiment.train(configure(tmp_path, f"logger={kind}"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is available")
def test_without_cuda_its_device_is_refused_as_such(tmp_path):
    with pytest.raises(ValueError, match=r"device=cuda: .* finds no CUDA device. Pass device=cpu"):
        experiment.train(configure(tmp_path, "device=cuda"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("overrides", [[], ["stage=transfer"]], ids=str)
def test_heading_without_pretraining_names_the_networks_that_come_with_the_library(tmp_path, overrides):
    with pytest.raises(ValueError, match="pretrained=builtin"):
        experiment.train(configure(tmp_path, *HEADING, *overrides))
    assert list(tmp_path.iterdir()) == []


def test_networks_that_do_not_come_with_the_library_are_not_offered(tmp_path):
    with pytest.raises(ValueError, match=r"pretrained=<folder>") as refusal:
        experiment.train(configure(tmp_path, *HEADING, "stage=transfer", "method=moe"))
    assert "builtin" not in str(refusal.value)


def test_where_a_pretraining_is_missing_the_benchmarks_that_run_both_stages_are_named(tmp_path):
    with pytest.raises(ValueError, match="benchmark=") as refusal:
        experiment.train(configure(tmp_path, *HEADING, "stage=transfer", "method=mcp"))
    name = re.search(r"benchmark=(\w+)", str(refusal.value))[1]
    rows = OmegaConf.load(Path(conf.__file__).with_name("benchmark") / f"{name}.yaml").rows
    assert any({"scratch", "mcp"} <= set(row.method) for row in rows)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["task=heading", "+task.evaluation.max_turns=0.1"], "the task has no argument max_turns"),
        (["task=carry", "task.evaluation.object_distances=[0,0.1]"], "object_distances"),
        (
            ["task=carry", "task.evaluation.speed=[0.5,1.0]"],
            r"speed=\[0.5, 1.0\] is out of range: pass a finite number",
        ),
    ],
    ids=str,
)
def test_what_the_evaluation_would_refuse_is_refused_before_training(tmp_path, settings, message):
    cfg = configure(tmp_path, "method=scratch", "evaluation.episodes=2", *settings)
    with pytest.raises(ValueError, match=message):
        experiment.train(cfg)
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("transfer.seed", "seed"),
        ("transfer.num_envs", "training.num_envs"),
        ("evaluation.seed", "evaluation.seed"),
        ("evaluation.num_envs", "evaluation.episodes"),
        ("evaluation.num_threads", "num_threads"),
    ],
)
def test_arguments_of_environments_that_the_run_gives_are_refused_in_the_task(tmp_path, name, setting):
    cfg = configure(tmp_path, "method=scratch", "task=heading", f"+task.{name}=3")
    with pytest.raises(ValueError, match=f"task.{name} would not be read: give {setting} instead"):
        experiment.train(cfg)


@pytest.mark.parametrize(("module", "written"), [("calendar", True), ("calendar", False), ("yaml", True)])
def test_a_module_of_ones_own_with_the_name_of_another_is_refused_by_its_name(tmp_path, monkeypatch, module, written):
    monkeypatch.chdir(tmp_path)
    if written:
        Path(f"{module}.py").write_text("")
    with pytest.raises(ValueError, match=rf"character=x is in the module {module}, but .*rename"):
        requirements.import_own(module, "character=x is in the module")


def test_a_task_of_ones_own_in_a_module_that_python_has_too_is_refused_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("calendar.py").write_text("class Mine: ...")
    with pytest.raises(ValueError, match=r"calendar\.Mine, but .*rename"):
        experiment.train(configure(tmp_path, *HEADING, "method=scratch", "task.transfer._target_=calendar.Mine"))
    assert list(tmp_path.iterdir()) == [tmp_path / "calendar.py"]


def test_a_module_of_ones_own_is_taken_from_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("mine_alone.py").write_text("MINE = True")
    requirements.import_own("mine_alone", "character=x is in the module")
    assert sys.modules.pop("mine_alone").MINE


@pytest.fixture
def begun(monkeypatch):
    """The arguments of every run that begins at W&B, which need not be installed."""
    calls = []
    fake = SimpleNamespace(init=lambda **arguments: calls.append(arguments) or SimpleNamespace(config={}))
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr("torchrl.record.loggers.wandb._has_wandb", True)
    return calls


def make_loggers(folder, *overrides):
    folder.mkdir(exist_ok=True)
    quiet = "+logger.wandb_kwargs.log_env_packages=false"
    cfg = compose_run("preset=smoke", "logger=wandb", f"run_dir={folder}", quiet, *overrides)
    for logger in build.make_loggers(cfg, SimpleNamespace(progress=SimpleNamespace(frames=0)), folder):
        assert logger.experiment


def test_a_resumed_run_goes_on_with_its_run_at_wandb_and_another_begins_its_own(tmp_path, begun):
    for name in ("one", "one", "other"):
        make_loggers(tmp_path / name)
    first, resumed, other = (arguments["id"] for arguments in begun)
    assert first == resumed != other
    assert {arguments["resume"] for arguments in begun} == {"allow"}


def test_an_identifier_that_the_user_gives_is_that_of_the_run_at_wandb(tmp_path, begun):
    make_loggers(tmp_path / "one", "+logger.wandb_kwargs.id=mine")
    assert [arguments["id"] for arguments in begun] == ["mine"]
