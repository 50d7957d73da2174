"""The guide's commands for environments of other libraries train, resume, evaluate and film."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import isaac
import pytest
from PIL import Image
from smoke import SMOKE, rows

from torchrl_mcp.envs.rendering import opengl
from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.results import find_runs
from torchrl_mcp.training.run_folder import EVALUATION, read_json

GUIDE = Path(__file__).parents[1] / "docs" / "guide"
COMMAND = re.compile(r"^torchrl-mcp-train ((?:.*\\\n)*.*)$", re.MULTILINE)
SHORT = (
    *SMOKE,
    *("evaluation.episodes=2", "training.num_envs=4", "training.frames_per_batch=128"),
    *("training.minibatch_size=64", "training.total_frames=256"),
)
STEPS = 20
"""Most steps of an episode in these tests."""


def commands(name):
    """Arguments of the guide's training commands that name a module or an environment."""
    text = (GUIDE / "own_environment.md").read_text()
    lines = [line.replace("\\\n", " ") for line in COMMAND.findall(text) if name in line]
    assert lines
    return [shlex.split(line) for line in lines]


@pytest.fixture
def train(command, tmp_path, monkeypatch):
    """Run the guide's training commands that name something, as the smallest runs; return their folders."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(GUIDE)

    def call(name, *settings):
        folders = []
        for words in commands(name):
            stage = "pretrain" if "stage=pretrain" in words else "transfer"
            chosen = [setting.format(stage=stage) for setting in settings]
            outcome = command("train", *words, *SHORT, *chosen, cwd=tmp_path)
            assert not outcome.returncode, outcome.stderr
            folders.append(next(tmp_path / word.partition("=")[2] for word in words if word.startswith("run_dir=")))
        return folders

    return call


def require_whole(folders):
    """Check that runs took all their steps, and were evaluated in episodes that their time limit ended."""
    for folder in folders:
        assert int(rows(folder)[-1]["frames"]) == 256
        evaluation = read_json(folder / EVALUATION)
        for mode in ("deterministic", "stochastic"):
            assert evaluation[mode]["length"] == STEPS
            assert evaluation[mode]["terminated"] == 0


def require_resumed(command, folder, *options):
    outcome = command("train", *options, f"resume={folder}", "training.total_frames=384")
    assert not outcome.returncode, outcome.stderr
    assert "begins new episodes" in outcome.stdout
    assert int(rows(folder)[-1]["frames"]) == 384


def require_film(folder, *options):
    """Film in a process of its own, because the control suite's renderer waits for ever when it is collected."""
    if not opengl._platform():
        pytest.skip("there is no OpenGL library for drawing without a display")
    film = folder / "film.gif"
    words = [sys.executable, "-m", "torchrl_mcp.commands.play", *options, folder, "--output", film, "--seconds", "1"]
    outcome = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, capture_output=True, text=True
    )
    assert not outcome.returncode, outcome.stderr
    with Image.open(film) as pictures:
        assert pictures.n_frames > 5
        pictures.seek(pictures.n_frames - 1)
        assert len(pictures.convert("RGB").getcolors(10**6)) > 50


def test_the_guides_benchmark_trains_in_both_stages_and_is_reported(command, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(GUIDE)
    words = ("--config-dir", GUIDE / "own", "benchmark=cheetah", "method=mcp", "seed=0", f"run_root={tmp_path}")
    outcome = command("train", *words, *SHORT, cwd=tmp_path)
    assert not outcome.returncode, outcome.stderr
    (pretraining, transfer) = cells(find_runs([tmp_path])[0])
    assert {pretraining.stage, transfer.stage} == {"pretrain", "transfer"}
    for cell in (pretraining, transfer):
        assert cell.place == ("gymnasium", "cheetah:CheetahSpeeds-v0")
        assert cell.metrics["speed_error"] > 0
        assert int(rows(cell.runs[0].path)[-1]["frames"]) == 256


def test_tasks_of_the_control_suite_train_in_both_stages_and_are_filmed(train, command):
    pytest.importorskip("dm_control", reason="dm_control is not installed: pip install dm_control")
    folders = train("walker.make", f"+task.{{stage}}.max_episode_steps={STEPS}")
    require_whole(folders)
    require_resumed(command, folders[1], "--trust", "walker")
    require_film(folders[1], "--trust", "walker")


def test_goals_of_gymnasium_robotics_train_in_both_stages_and_are_filmed(train, command):
    robotics = "gymnasium_robotics"
    pytest.importorskip(robotics, reason="it is not installed: pip install gymnasium-robotics")
    folders = train("gymnasium_robotics:", f"+task.{{stage}}.max_episode_steps={STEPS}")
    require_whole(folders)
    assert "task/success" in rows(folders[1])[-1]
    require_resumed(command, folders[1])
    require_film(folders[1])


@pytest.mark.slow  # Warp compiles the kernels for minutes
def test_robots_of_mjlab_train_in_both_stages(train):
    reason = "mjlab is not installed with its requirements, and mujoco-warp 3.17"
    pytest.importorskip("mjlab.tasks.registry", reason=reason, exc_type=ImportError)
    place = ("device=cpu", "+task.{stage}.env.device=cpu")
    require_whole(train("quadruped.make", *place, f"+task.{{stage}}.max_episode_steps={STEPS}"))


def test_threads_of_envpool_train_and_resume(train, command):
    pytest.importorskip("envpool", reason="envpool is not installed: pip install 'torchrl-mcp[bench]'")
    folders = train("pool.Pool", f"+task.transfer.max_episode_steps={STEPS}")
    require_whole(folders)
    require_resumed(command, folders[0], "--trust", "pool")


def test_a_simulator_that_resets_itself_trains_in_both_stages_and_is_evaluated(train, command, monkeypatch):
    isaac.install(monkeypatch)
    place = ("device=cpu", "+task.{stage}.env.device=cpu", "evaluation.episodes=0")
    folders = train("anymal.make", *place)
    for folder in folders:
        last = rows(folder)[-1]
        assert int(last["frames"]) == 256
        assert 1 < float(last["episode/length"]) <= isaac.LIMIT
    require_resumed(command, folders[1], "--trust", "anymal")
    outcome = command("evaluate", "--trust", "anymal", folders[1], "--episodes", "8")
    assert not outcome.returncode, outcome.stderr
    assert re.search(r"length [1-6],", outcome.stdout)


def test_a_sweep_over_environments_has_a_table_for_each_in_the_report(train, command, tmp_path):
    (words,) = commands("--multirun")
    outcome = command("train", *words, *SHORT, f"+task.transfer.max_episode_steps={STEPS}", cwd=tmp_path)
    assert not outcome.returncode, outcome.stderr
    runs, damaged = find_runs([tmp_path / "runs"])
    assert not damaged
    tables = {cell.place: [run.seed for run in cell.runs] for cell in cells(runs)}
    assert tables == {("gymnasium", "Pendulum-v1"): [0, 1], ("gymnasium", "InvertedPendulum-v5"): [0, 1]}
    assert not command("report", tmp_path / "runs", cwd=tmp_path).returncode
    page = (tmp_path / "report" / "report.md").read_text()
    for id in ("Pendulum-v1", "InvertedPendulum-v5"):
        assert f"## Transfer: Gymnasium: {id}\n" in page
