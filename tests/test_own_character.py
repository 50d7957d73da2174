"""The tutorial on a character from a file, command by command, with the smallest budgets."""

import contextlib
import re
import shlex
import sys
from pathlib import Path

import pytest

from torchrl_mcp.cli import character, play, train
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.rendering import opengl

TUTORIAL = (Path(__file__).parents[1] / "docs" / "tutorials" / "character.md").read_text()
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"^(torchrl-mcp-\w+) (.*)$", re.MULTILINE)
PROGRAMS = {f"torchrl-mcp-{module.__name__.rpartition('.')[2]}": module for module in (character, play, train)}
SMALLER = {
    "torchrl-mcp-train": "preset=smoke logger=none num_threads=1 torch_threads=1 progress_bar=false "
    "training.total_frames=128 hydra/job_logging=none hydra/hydra_logging=none",
    "torchrl-mcp-play": "--seconds 0.2 --width 64 --height 48",
}


@pytest.fixture(scope="module")
def called(tmp_path_factory):
    """How each command of the tutorial ended, in a folder that is its working directory."""
    folder, outcomes = tmp_path_factory.mktemp("tutorial"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        path = list(sys.path)
        for code in PYTHON.findall(TUTORIAL):
            exec(compile(code, "character.md", "exec"), {})
        for program, arguments in COMMAND.findall(TUTORIAL):
            if program == "torchrl-mcp-play" and opengl._platform() is None:
                continue
            forget()  # each command has a process of its own
            patch.setattr(sys, "path", list(path))
            patch.setattr(sys, "argv", shlex.split(f"{program} {arguments} {SMALLER.get(program, '')}"))
            try:
                PROGRAMS[program].main()
                code = 0
            except SystemExit as stop:
                code = stop.code
            outcomes.append((f"{program} {arguments}", code))
        yield folder, outcomes
    forget()


def forget():
    """Remove the tutorial's module and character from this process."""
    sys.modules.pop("gymnast", None)
    CHARACTERS.pop("gymnast", None)


def test_only_the_first_check_finds_something(called):
    _, [(first, code), *others] = called
    assert (first, code) == ("torchrl-mcp-character check humanoid.xml", 1)
    assert [(line, code) for line, code in others if code] == []
    assert {line.split()[0] for line, _ in others} >= {"torchrl-mcp-character", "torchrl-mcp-train"}


def test_the_folder_holds_what_the_tutorial_names(called):
    folder, _ = called
    for name in ("gymnast.xml", "gymnast.py", "own/character/gymnast.yaml", "runs/gymnast/metrics.csv"):
        assert (folder / name).is_file()
    assert CHARACTERS["gymnast"].feet == ("right_foot", "left_foot")


def test_adapting_again_overwrites_nothing_and_says_what_to_do(called, monkeypatch):
    folder, _ = called
    before = {path: path.read_bytes() for path in folder.glob("*.*")}
    for source, name in (("humanoid.xml", "gymnast"), ("humanoid.xml", "humanoid")):
        arguments = ["torchrl-mcp-character", "adapt", str(folder / source), "--name", name, "--output", str(folder)]
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit, match=f"{name}.xml is there already: pass another --name or --output"):
            character.main()
    assert before == {path: path.read_bytes() for path in folder.glob("*.*")}


def test_the_next_commands_begin_in_the_folder_of_the_files(called, tmp_path, monkeypatch, capsys):
    folder, _ = called
    monkeypatch.chdir(tmp_path)
    arguments = ["adapt", str(folder / "humanoid.xml"), "--name", "athlete", "--output", "bodies"]
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-character", *arguments])
    with contextlib.suppress(SystemExit):
        character.main()
    assert "Next:\n  cd bodies\n  torchrl-mcp-play" in capsys.readouterr().out
    assert (tmp_path / "bodies" / "own" / "character" / "athlete.yaml").is_file()


@pytest.mark.skipif(opengl._platform() is None, reason="no OpenGL to draw with")
def test_it_ends_with_a_film(called):
    folder, _ = called
    assert all((folder / name).stat().st_size > 1000 for name in ("still.gif", "random.gif", "walk.gif"))
