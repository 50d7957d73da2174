"""Every command answers at once what needs no library of seconds."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from torchrl_mcp import __version__
from torchrl_mcp.cli import train

ROOT = Path(__file__).parents[2]
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
SLOW = ("hydra", "mujoco", "torch", "torchrl")
CALL = """
import atexit, importlib, sys
module, function = sys.argv.pop(1).split(":")
atexit.register(lambda: print(*sorted({slow} & set(sys.modules)), sep=",", file=sys.stderr))
getattr(importlib.import_module(module), function)()
"""


def call(command, *words):
    """Call a command in a process of its own; return that, and which slow libraries it has imported."""
    code = CALL.replace("{slow}", repr(set(SLOW)))
    words = [sys.executable, "-c", code, COMMANDS[command], *words]
    outcome = subprocess.run(words, capture_output=True, text=True)
    *_, imported = outcome.stderr.splitlines()
    return outcome, imported


@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_no_slow_library(command):
    outcome, imported = call(command, "--help")
    assert (outcome.returncode, imported) == (0, "")
    assert f"usage: {command}" in outcome.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_says_its_version(command):
    outcome, imported = call(command, "--version")
    assert (outcome.returncode, imported) == (0, "")
    assert outcome.stdout.strip() == f"{command} {__version__}"


@pytest.mark.parametrize(
    ("command", "words", "answer"),
    [
        ("torchrl-mcp-play", ["nowhere"], "there is no nowhere: give a run folder"),
        ("torchrl-mcp-play", ["builtin:horse"], "no builtin:horse comes with the library: give one of builtin:biped"),
        ("torchrl-mcp-play", ["builtin:biped", "--output", "film.avi"], "film.avi is not the name of a film"),
        ("torchrl-mcp-evaluate", ["nowhere"], "there is no nowhere: give a run folder"),
        ("torchrl-mcp-figures", ["primitives", "nowhere"], "there is no nowhere: give a run folder"),
        ("torchrl-mcp-motions", ["inspect", "nowhere.bvh"], "there is no nowhere.bvh"),
        ("torchrl-mcp-report", ["nowhere"], "there is no folder nowhere"),
        ("torchrl-mcp-status", ["nowhere"], "there is no folder nowhere"),
    ],
)
def test_a_simple_error_imports_no_slow_library(command, words, answer):
    outcome, imported = call(command, *words)
    assert outcome.returncode
    assert imported == ""
    assert answer in outcome.stderr


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
