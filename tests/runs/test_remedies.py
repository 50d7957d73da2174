"""What this machine or the command line lacks is said before a folder exists."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp import conf
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.runs import build, experiment, imports, requirements
from torchrl_mcp.runs.configuration import compose_run

HEADING = ["task=heading", "character=humanoid"]
SCRATCH = ["method=scratch", "evaluation.episodes=2"]
WITHOUT_CUDA = pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is available")


@pytest.mark.parametrize(
    ("overrides", "names"),
    [
        pytest.param(["device=cuda"], ["device=cuda", "device=cpu"], marks=WITHOUT_CUDA),
        (["device=mps"], ["device=mps"]),
        (["device=meta"], ["device=meta"]),
        (["mixer.name=additive"], ["mixer.name=additive", "MultiplicativeGaussian"]),
        (["logger=wandb"], ["logger=wandb", "torchrl-mcp[wandb]"]),
        (["logger=mlflow"], ["logger=mlflow", "torchrl-mcp[mlflow]"]),
        ([*HEADING], ["pretrained=builtin"]),
        ([*HEADING, "stage=transfer"], ["pretrained=builtin"]),
        ([*HEADING, "stage=transfer", "method=moe"], ["pretrained=<folder>"]),
        (["task=heading", "stage=transfer", "character=ant"], ["character=ant", "character=biped"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.max_turns=0.1"], ["max_turns"]),  # in the evaluation alone
        ([*SCRATCH, "task=carry", "task.evaluation.object_distances=[0,0.1]"], ["object_distances"]),
        ([*SCRATCH, "task=carry", "task.evaluation.speed=[0.5,1.0]"], ["speed=[0.5, 1.0]"]),
        ([*SCRATCH, "task=heading", "+task.transfer.seed=3"], ["task.transfer.seed"]),  # a run gives these itself
        ([*SCRATCH, "task=heading", "+task.transfer.num_envs=3"], ["task.transfer.num_envs", "training.num_envs"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.seed=3"], ["task.evaluation.seed"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.num_envs=3"], ["task.evaluation.num_envs"]),
        ([*SCRATCH, "task=heading", "+task.evaluation.num_threads=3"], ["task.evaluation.num_threads"]),
    ],
    ids=lambda value: value[-1],
)
def test_what_cannot_be_trained_or_evaluated_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, overrides, names
):
    monkeypatch.setattr(requirements, "find_spec", lambda name: None)
    cfg = compose_run("preset=smoke", "logger=none", f"run_dir={tmp_path / 'run'}", *overrides)
    message = refused(lambda: experiment.train(cfg), *names, untouched=tmp_path)
    assert ("pretrained=builtin" in message) == ("pretrained=builtin" in names)


def configure(folder, *overrides):
    return compose_run("preset=smoke", "logger=none", f"run_dir={folder / 'run'}", *overrides)


def test_where_a_pretraining_is_missing_the_benchmarks_that_run_both_stages_are_named(tmp_path):
    with pytest.raises(ValueError, match="benchmark=") as refusal:
        experiment.train(configure(tmp_path, *HEADING, "stage=transfer", "method=mcp"))
    name = re.search(r"benchmark=(\w+)", str(refusal.value))[1]
    rows = OmegaConf.load(Path(conf.__file__).with_name("benchmark") / f"{name}.yaml").rows
    assert any({"scratch", "mcp"} <= set(row.method) for row in rows)


def test_a_wrong_setting_to_which_others_refer_is_named_once(tmp_path):
    message = refused(lambda: experiment.train(configure(tmp_path, "width=nan")), "width=nan", untouched=tmp_path)
    assert message.count("width") == 1


@pytest.mark.parametrize(("module", "written"), [("calendar", True), ("calendar", False), ("yaml", True)])
def test_a_module_of_ones_own_with_the_name_of_another_is_refused_by_its_name(tmp_path, monkeypatch, module, written):
    monkeypatch.chdir(tmp_path)
    if written:
        Path(f"{module}.py").write_text("")
    with pytest.raises(ValueError, match=rf"character=x is in the module {module}, but .*rename"):
        imports.import_own(module, "character=x is in the module")


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
    imports.import_own("mine_alone", "character=x is in the module")
    assert sys.modules.pop("mine_alone").MINE


TASK = """
from torchrl_mcp.envs import Heading

class Approach(Heading):
    def __init__(self, *args, radius=1.0, **kwargs):
        super().__init__(*args, **kwargs)
"""


def test_a_misspelt_argument_of_a_task_of_ones_own_is_refused_with_the_argument_that_it_takes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("approach_task.py").write_text(TASK)
    task = [*HEADING, *SCRATCH, "task.transfer._target_=approach_task.Approach", "+task.transfer.radus=1.0"]
    refused(lambda: experiment.train(configure(tmp_path, *task)), "task.transfer.radus", "radius")


CHARACTER = """
from dataclasses import replace
from pathlib import Path

from torchrl_mcp.envs import characters

biped = characters.CHARACTERS["biped"]
body = Path(characters.__file__).with_name("biped.xml")
characters.CHARACTERS["footless"] = replace(biped, name="footless", feet=(), file=body)
"""


def test_a_character_of_ones_own_that_breaks_the_rules_is_named_with_the_rule(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(CHARACTERS, "footless", None)  # is removed after the test
    Path("footless_body.py").write_text(CHARACTER)
    cfg = configure(tmp_path, *HEADING, *SCRATCH, "character.name=footless", "+character.module=footless_body")
    with pytest.warns(UserWarning, match="character=footless breaks rules.*no feet are named"):
        imports.require_environment(cfg)


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
