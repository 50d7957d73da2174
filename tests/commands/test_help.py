"""Every command answers at once what needs no library of seconds."""

import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
from refusals import refused

from torchrl_mcp import __version__
from torchrl_mcp.commands import main, train

ROOT = Path(__file__).parents[2]
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
SLOW = ("hydra", "mujoco", "torch", "torchrl")
CALL = """
import atexit, importlib, sys
module, function = sys.argv.pop(1).split(":")
atexit.register(lambda: print(*sorted({slow} & set(sys.modules)), sep=",", file=sys.stderr))
getattr(importlib.import_module(module), function)()
"""
CALL_ALL = """
import importlib, sys
word, *programs = sys.argv[1:]
for program in programs:
    module, function = program.split(":")
    sys.argv = [module, word]
    try:
        getattr(importlib.import_module(module), function)()
    except SystemExit as end:
        print(program, end.code or 0, {slow} & set(sys.modules), file=sys.stderr)
"""


def call(command, *words):
    """Call a command in a process of its own; return that, and which slow libraries it has imported."""
    code = CALL.replace("{slow}", repr(set(SLOW)))
    words = [sys.executable, "-c", code, COMMANDS[command], *words]
    outcome = subprocess.run(words, capture_output=True, text=True)
    *_, imported = outcome.stderr.splitlines()
    return outcome, imported


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_the_command_and_the_version_is_the_librarys(command, monkeypatch, capsys):
    program, _, function = COMMANDS[command].partition(":")
    for word, answer in (("--help", f"usage: {command}"), ("--version", f"{command} {__version__}\n")):
        monkeypatch.setattr(sys, "argv", [command, word])
        with pytest.raises(SystemExit) as end:
            getattr(import_module(program), function)()
        assert not end.value.code
        assert answer in capsys.readouterr().out  # a web viewer of another test may print at the same time


@pytest.mark.parametrize("word", ["--help", "--version"])
def test_help_and_version_import_no_slow_library(word):
    code = CALL_ALL.replace("{slow}", repr(set(SLOW)))
    outcome = subprocess.run([sys.executable, "-c", code, word, *COMMANDS.values()], capture_output=True, text=True)
    assert outcome.stderr.splitlines() == [f"{program} 0 set()" for program in COMMANDS.values()]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("torchrl-mcp-play", ["nowhere"]),
        ("torchrl-mcp-play", ["builtin:horse"]),
        ("torchrl-mcp-play", ["builtin:biped", "--output", "film.avi"]),
        ("torchrl-mcp-evaluate", ["nowhere"]),
        ("torchrl-mcp-figures", ["primitives", "nowhere"]),
        ("torchrl-mcp-motions", ["inspect", "nowhere.bvh"]),
        ("torchrl-mcp-report", ["nowhere"]),
        ("torchrl-mcp-status", ["nowhere"]),
    ],
)
def test_a_simple_error_names_what_is_wrong_and_imports_no_slow_library(command, words):
    outcome, imported = call(command, *words)
    assert outcome.returncode
    assert imported == ""
    assert words[-1] in outcome.stderr


@pytest.mark.parametrize("words", [["method=horse"], ["sead=1"], ["task=heading", "--cfg", "job"]])
def test_what_hydra_answers_needs_hydra_alone(words):
    outcome, imported = call("torchrl-mcp-train", *words)
    assert imported == "hydra"
    assert ("heading" in outcome.stdout) == ("--cfg" in words)


def test_the_choices_of_help_are_those_that_hydra_has():
    from hydra import compose, initialize_config_module

    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        known = {
            group for group in compose("train", return_hydra_config=True).hydra.runtime.choices if "/" not in group
        }
    assert set(train.GROUPS) <= known
    assert "mcp" in train.choices("method")
    assert "mcp" in train.parser().format_help()


@pytest.mark.parametrize("name", [name.removeprefix("torchrl-mcp-") for name in COMMANDS if name != "torchrl-mcp"])
def test_one_program_has_all_commands(name, monkeypatch, capsys):
    outputs = []
    for words in ([f"torchrl-mcp-{name}", "--help"], ["torchrl-mcp", name, "--help"]):
        program = words[0]
        monkeypatch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as end:
            import_module(COMMANDS[program].partition(":")[0]).main()
        assert not end.value.code
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]
    assert name in main.COMMANDS


def test_a_word_that_is_no_command_is_answered_with_the_nearest(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp", "trian"])
    refused(main.main, "train", error=SystemExit)
