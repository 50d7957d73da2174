"""What the command says when a run fails: a sentence with what is safe and how to go on."""

import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from hydra.errors import InstantiationException
from omegaconf import OmegaConf

from torchrl_mcp.commands import train
from torchrl_mcp.envs import characters
from torchrl_mcp.runs import experiment


@pytest.fixture(params=["begun", "not begun"])
def cfg(request, tmp_path):
    if request.param == "begun":
        (tmp_path / "config.yaml").write_text("seed: 0")
    return OmegaConf.create({"resume": None, "run_dir": str(tmp_path)})


def said(cfg, monkeypatch, failure):
    def fail(cfg):
        raise failure

    monkeypatch.setattr(experiment, "train", fail)
    with pytest.raises(SystemExit) as stop:
        train.train(cfg)
    assert stop.value.code not in (0, 1)
    return str(stop.value.code)


@pytest.mark.parametrize(
    ("failure", "sentence"),
    [
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device. "),
        (ChildProcessError("worker 0 of 2 has ended"), "worker 0 of 2 has ended. "),
        (FloatingPointError("loss became nan"), "loss became nan. "),
        (KeyboardInterrupt(), "interrupted. "),
    ],
)
def test_what_comes_from_outside_ends_in_a_sentence_with_what_is_safe_and_how_to_go_on(
    cfg, monkeypatch, tmp_path, failure, sentence
):
    begun = (tmp_path / "config.yaml").exists()
    safe = f"go on with torchrl-mcp-train resume={tmp_path}" if begun else "No run has begun"
    text = said(cfg, monkeypatch, failure)
    assert text.strip().startswith(f"torchrl-mcp-train: {sentence}")
    assert safe in text


def test_an_object_that_cannot_be_made_is_named_with_the_reason(cfg, monkeypatch):
    failure = InstantiationException("Error in call to target 'x':\nTypeError")
    assert "Error in call to target 'x':; TypeError" in said(cfg, monkeypatch, failure)


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "nowhere"],
        ["motions", "inspect", "nowhere"],
        ["play", "nowhere"],
        ["train", "resume=nowhere"],
        ["evaluate", "builtin:biped", "--task", "key=[1"],
    ],
    ids=" ".join,
)
def test_in_development_mode_a_command_ends_with_a_traceback(words, tmp_path):
    command = [sys.executable, "-X", "dev", "-W", "ignore", "-m", f"torchrl_mcp.commands.{words[0]}", *words[1:]]
    assert "Traceback" in subprocess.run(command, capture_output=True, text=True, cwd=tmp_path).stderr


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["evaluate", "run", "--seed", "-1"], "--seed: '-1'"),
        (["evaluate", "run", "--episodes", "0"], "--episodes: '0'"),
        (["play", "run", "--viewer", "web", "--port", "70000"], "--port: '70000'"),
        (["evaluate", "builtin:biped", "--task", "max_episode_steps=abc"], "max_episode_steps=abc"),
        (["evaluate", "builtin:biped", "--task", "speed=${"], "--task speed=${"),
        (["evaluate", "builtin:biped", "--task", "[=1"], "--task [=1"),
        (["evaluate", "builtin:biped-heading", "--task", "curriculum=none"], "curriculum=none"),
    ],
    ids=lambda words: words[-1],
)
def test_an_option_with_a_wrong_value_is_named(words, name, capsys):
    with pytest.raises(SystemExit) as stop:
        import_module(f"torchrl_mcp.commands.{words[0]}").main(words[1:])
    assert name in f"{stop.value.code}{capsys.readouterr().err}"


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "builtin:biped", "--episodes", "1", "--task", "max_episode_steps=2", "--output", "file/out.json"],
        ["export", "builtin:biped", "--torch", "file/out.pt2"],
        ["report", "run", "--output", "file/out"],
        ["figures", "curves", "run", "--output", "file/out"],
        ["character", "adapt", "robot.xml", "--name", "robot2", "--output", "file/out"],
    ],
    ids=lambda words: words[0],
)
def test_a_result_that_cannot_be_written_ends_in_a_sentence(words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.yaml").write_text("seed: 0")
    shutil.copy(Path(characters.__file__).with_name("biped.xml"), "robot.xml")
    (tmp_path / "run/metrics.csv").write_text("iteration,frames,episode/count,episode/normalised_return\n1,128,1,0.5\n")
    with pytest.raises(SystemExit) as stop:
        import_module(f"torchrl_mcp.commands.{words[0]}").main(words[1:])
    assert re.fullmatch(rf"torchrl-mcp-{words[0]}: .*(File exists|Not a directory): 'file.*'", str(stop.value.code))


def test_a_reader_that_closes_the_output_ends_the_command_silently(tmp_path):
    program = [sys.executable, "-m", "torchrl_mcp.commands.status", "."]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path) as command:
        command.stdout.close()
        errors = command.stderr.read().decode()
    assert errors == ""
    assert command.returncode == 141
