"""A body from a file becomes a character that trains: Gymnasium's humanoid, and the tutorial on robots, in small."""

import glob
import re
import shlex
import shutil
import sys
from pathlib import Path

import gymnasium
import pytest

from torchrl_mcp.commands import character, motions, play, train
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions import MotionClip
from torchrl_mcp.envs.rendering import opengl

HUMANOID = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "humanoid.xml"
TUTORIAL = (Path(__file__).parents[1] / "docs" / "tutorials" / "character.md").read_text()
STEP = re.compile(r"^```python\n(?P<code>.*?)^```$|^(?P<line>torchrl-mcp-\w+ [^\n]*)$", re.DOTALL | re.MULTILINE)
GYMNAST = """
torchrl-mcp-character check humanoid.xml
torchrl-mcp-character adapt humanoid.xml --name gymnast --pose knee=-0.035
torchrl-mcp-character check gymnast.xml
torchrl-mcp-train --config-dir own task=heading character=gymnast method=scratch run_dir=runs/gymnast
torchrl-mcp-play --trust gymnast runs/gymnast --output walk.gif
"""
MODULES = (character, motions, play, train)
PROGRAMS = {f"torchrl-mcp-{module.__name__.rpartition('.')[2]}": module for module in MODULES}
TRAINING = (
    "preset=smoke logger=none num_threads=1 torch_threads=1 progress_bar=false training.total_frames=128 "
    "hydra/job_logging=none hydra/hydra_logging=none"
)
SMALLER = {
    "torchrl-mcp-train": TRAINING,
    "torchrl-mcp-play": "--seconds 0.2 --width 64 --height 48",
    "torchrl-mcp-motions": "--rate 10",
}


def follow(text, folder, names):
    """Run the Python and the commands of a text in a folder; return each command with its status."""
    outcomes, namespace = [], {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        path = list(sys.path)
        for step in STEP.finditer(text):
            if code := step["code"]:
                exec(compile(code, "tutorial", "exec"), namespace)
                continue
            program, _, arguments = step["line"].partition(" ")
            if (program == "torchrl-mcp-play" or " render " in step["line"]) and opengl._platform() is None:
                continue
            forget(names)  # each command has a process of its own
            patch.setattr(sys, "path", list(path))
            smaller = "--seconds 0.2" if " render " in step["line"] else SMALLER.get(program, "")
            words = shlex.split(f"{step['line']} {smaller}")
            patch.setattr(sys, "argv", [name for word in words for name in sorted(glob.glob(word)) or [word]])
            try:
                PROGRAMS[program].main()
                status = 0
            except SystemExit as stop:
                status = stop.code
            outcomes.append((f"{program} {arguments}", status))
    return outcomes


def forget(names):
    """Remove modules and characters from this process."""
    for name in names:
        sys.modules.pop(name, None)
        CHARACTERS.pop(name, None)


@pytest.fixture(scope="module")
def gymnast(tmp_path_factory):
    """How each command with Gymnasium's humanoid ended, in a folder that is its working directory."""
    folder = tmp_path_factory.mktemp("gymnast")
    shutil.copy(HUMANOID, folder / "humanoid.xml")
    yield folder, follow(GYMNAST, folder, ["gymnast"])
    forget(["gymnast"])


@pytest.fixture(scope="module")
def robots(robot_file, tmp_path_factory):
    """How each command of the tutorial ended."""
    robot_file("go1")
    folder = tmp_path_factory.mktemp("tutorial")
    yield folder, follow(TUTORIAL, folder, ["go1", "g1"])
    forget(["go1", "g1"])


def test_gymnasiums_humanoid_trains_although_it_cannot_hold_its_rest_pose(gymnast):
    folder, outcomes = gymnast
    assert [status for _, status in outcomes] == [1, 1, 1, 0, 0][: len(outcomes)]  # it has no ankles to balance with
    for name in ("gymnast.xml", "gymnast.py", "own/character/gymnast.yaml", "runs/gymnast/metrics.csv"):
        assert (folder / name).is_file()
    assert CHARACTERS["gymnast"].feet == ("right_foot", "left_foot")


def test_every_command_of_the_tutorial_succeeds(robots):
    _, outcomes = robots
    assert [(line, status) for line, status in outcomes if status] == []
    assert {line.split()[0] for line, _ in outcomes} >= {"torchrl-mcp-character", "torchrl-mcp-motions"}


def test_the_folder_holds_what_the_tutorial_names(robots):
    folder, _ = robots
    for name in ("go1.xml", "go1.py", "own/character/go1.yaml", "runs/go1/metrics.csv", "runs/g1_heading/metrics.csv"):
        assert (folder / name).is_file()
    assert MotionClip.load(folder / "g1_walks" / "walk_1.npz").character == "g1"


def test_the_table_of_the_tutorial_is_the_commands(robots, command, tmp_path):
    folder, _ = robots
    done = command(
        "character",
        "adapt",
        folder / "robots" / "go1.xml",
        *["--name", "dog", "--pose", "thigh=0.9", "calf=-1.8"],
        cwd=tmp_path,
    )
    (row,) = re.findall(r"^FR_calf .*$", TUTORIAL, re.MULTILINE)
    assert row.split() in [line.split() for line in done.stdout.splitlines()]


def test_adapting_again_overwrites_nothing_and_says_what_to_do(gymnast, command):
    folder, _ = gymnast
    before = {path: path.read_bytes() for path in folder.glob("*.*")}
    for name in ("gymnast", "humanoid"):
        arguments = ("humanoid.xml", "--pose", "knee=-0.035", "--name", name)
        done = command("character", "adapt", *arguments, cwd=folder)
        assert f"{name}.xml exists already: pass another --name or --output" in done.stderr
    assert before == {path: path.read_bytes() for path in folder.glob("*.*")}


@pytest.mark.parametrize("output", ["bodies", "my bodies"])
def test_the_next_commands_begin_in_the_folder_of_the_files(gymnast, command, tmp_path, output):
    folder, _ = gymnast
    arguments = (folder / "humanoid.xml", "--pose", "knee=-0.035", "--name", "athlete", "--output", output)
    done = command("character", "adapt", *arguments, cwd=tmp_path)
    (line,) = re.findall(r"Next:\n  (cd .*)\n  torchrl-mcp-play", done.stdout)
    assert shlex.split(line) == ["cd", output]
    assert (tmp_path / output / "own" / "character" / "athlete.yaml").is_file()


def test_files_are_utf_8_in_any_locale(command, tmp_path, monkeypatch):
    (tmp_path / "humanoid.xml").write_text(HUMANOID.read_text().replace("_foot", "_fuß"), encoding="utf-8")
    monkeypatch.setattr("io.text_encoding", lambda encoding, stacklevel=2: encoding or "latin-1")
    command("character", "adapt", "humanoid.xml", "--name", "turner", "--pose", "knee=-0.035", cwd=tmp_path)
    for suffix in ("xml", "py"):
        assert "right_fuß" in (tmp_path / f"turner.{suffix}").read_bytes().decode()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--torque knee", "'knee' must have the form PATTERN=NUMBER, such as ankle=50"),
        ("--torque knee=-3", "'knee=-3' must have the form PATTERN=NUMBER"),
        ("--gain (=5", "'(=5' must have the form PATTERN=NUMBER"),
        ("--name on", "'on' has a meaning in Python or YAML: choose another name"),
        ("--name class", "'class' has a meaning in Python or YAML"),
        ("--sides left", "'left' must have the form RIGHT:LEFT, such as FR_:FL_"),
        ("--pose crouch", "--pose crouch is not a keyframe of the file: its keyframes are 0, 1"),
        ("--gain ankle=5", "--gain ankle=5 matches no joint: they are lwaist, pelvis, right_thigh"),
        ("--root head", "the file has no body head for the root: pass one of torso, lwaist"),
    ],
)
def test_what_is_wrong_with_an_option_is_said_in_a_sentence(command, tmp_path, options, message):
    options = options if "--pose" in options else f"{options} --pose knee=-0.035"
    done = command("character", "adapt", HUMANOID, "--name", "gymnast", *options.split(), cwd=tmp_path)
    assert done.returncode
    assert message in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_units_other_than_metres_are_pointed_out(command, tmp_path):
    text = HUMANOID.read_text().replace("<option ", '<option gravity="0 0 -981" ')
    (tmp_path / "giant.xml").write_text(text)
    done = command("character", "adapt", "giant.xml", "--name", "titan", "--pose", "knee=-0.035", cwd=tmp_path)
    assert "units: gravity is 981 in the file, so its lengths are not in metres" in done.stdout


@pytest.mark.skipif(opengl._platform() is None, reason="no OpenGL to draw with")
def test_it_ends_with_a_film(gymnast):
    folder, _ = gymnast
    assert (folder / "walk.gif").stat().st_size > 1000


@pytest.mark.parametrize(("name", "owner"), [("trex", "a character of the library"), ("random", "a Python module, ")])
def test_names_that_would_be_taken_for_others_are_refused(gymnast, command, name, owner):
    folder, _ = gymnast
    done = command("character", "adapt", "humanoid.xml", "--pose", "knee=-0.035", "--name", name, cwd=folder)
    assert done.returncode == 1
    assert f"{name} is the name of {owner}" in done.stderr
    assert not (folder / f"{name}.xml").exists()
