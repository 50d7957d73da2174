import json
import math
import shutil

import pytest
from refusals import refused

from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.results import Damaged, Run, find_runs, read_run


def test_runs_are_found_at_any_depth_and_each_once(write_run, tmp_path):
    folders = [write_run("a"), write_run("b/c/d")]
    runs, damaged = find_runs([tmp_path / "runs", tmp_path / "runs" / "b", folders[0]])
    assert [run.path for run in runs] == folders
    assert not damaged


def test_runs_below_other_runs_and_behind_links_are_found(write_run, tmp_path):
    folders = [write_run("runs/exp"), write_run("runs/exp/longer"), write_run("elsewhere/run")]
    (tmp_path / "runs/runs/linked").symlink_to(folders[-1])
    (tmp_path / "runs/runs/exp/circle").symlink_to(tmp_path / "runs")
    shutil.copytree(folders[1], folders[0] / "checkpoints/run")  # what is in there is the run's own
    runs, _ = find_runs([tmp_path / "runs/runs"])
    assert sorted(run.path.resolve() for run in runs) == sorted(folders)


def test_a_config_yaml_alone_is_no_run_and_hides_none(write_run, tmp_path):
    run = write_run("run")
    (tmp_path / "config.yaml").write_text("x: 1\n")
    runs, damaged = find_runs([tmp_path])
    assert ([found.path for found in runs], damaged) == ([run], [])
    (run / "metrics.csv").unlink()  # before the first iteration
    assert [found.path for found in find_runs([tmp_path])[0]] == [run]


def test_one_of_several_paths_may_hold_no_run(write_run, tmp_path):
    run = write_run("run")
    (tmp_path / "multirun").mkdir()
    assert [found.path for found in find_runs([tmp_path / "multirun", run])[0]] == [run]


def test_a_run_knows_what_its_files_say(write_run):
    folder = write_run("run", method="moe", task="carry", character="trex", stage="pretrain", seed=7, score=0.75)
    run = read_run(folder)
    assert (run.place, run.method, run.stage, run.seed) == (("carry", "trex"), "moe", "pretrain", 7)
    assert (run.frames, run.total_frames, run.seconds) == (1000, 1000, 10.0)
    assert (run.preset, run.commit) == ("fast", "abc1234")
    assert run.evaluation["stochastic"]["normalised_return"] == pytest.approx(0.65)


def test_environments_of_another_library_have_their_name_in_place_of_a_character(write_run):
    ids = {"task__transfer__id": "Hopper-v5", "task__pretrain__id": "Ant-v5"}
    run = read_run(write_run("a", task="gymnasium", character="none", **ids))
    assert run.place == ("gymnasium", "Hopper-v5")
    run = read_run(write_run("b", task="gymnasium", character="none", stage="pretrain", **ids))
    assert run.place == ("gymnasium", "Ant-v5")
    run = read_run(write_run("c", task="torchrl", character="none", task__transfer__env___target_="walker.make"))
    assert run.place == ("torchrl", "walker.make")


@pytest.mark.parametrize(
    ("settings", "state"),
    [
        ({"score": 0.5}, "complete"),
        ({}, "not evaluated"),
        ({"progress": 0.5}, "unfinished"),
        ({"progress": 0.5, "score": 0.5}, "unfinished"),
        ({"progress": 0.0}, "unfinished"),
    ],
    ids=str,
)
def test_the_state_of_a_run_is_told(write_run, settings, state):
    run = read_run(write_run("run", **settings))
    assert run.state == state
    assert run.progress == settings.get("progress", 1.0)
    assert run.has_episodes == bool(run.progress)


def test_a_run_without_origin_has_unknown_preset_and_commit(write_run):
    run = read_run(write_run("run", preset=None, score=0.5))
    assert (run.state, run.preset, run.commit) == ("complete", "unknown", "unknown")


def test_a_run_whose_code_was_in_no_checkout_has_an_unknown_commit(write_run):
    assert read_run(write_run("run", commit=None)).commit == "unknown"


def test_an_episode_that_has_not_ended_is_no_learning_curve(write_run):
    folder = write_run("run")
    rows = (folder / "metrics.csv").read_text().replace(",1,0.5", ",0,nan")
    (folder / "metrics.csv").write_text(rows)
    assert not read_run(folder).has_episodes


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("metrics.csv", "iteration,frames\n1,many\n"),
        ("metrics.csv", "iteration,frames\n1,100\n"),
        ("metrics.csv", b"\xff\xfe\xff"),
        ("metrics.csv", "iteration,frames,seconds\n1,1e300,1\n"),
        ("metrics.csv", "iteration,frames,seconds\n1,9,1\n2,10\n"),
        ("evaluation.json", '{"episodes": 1'),
        ("evaluation.json", '{"deterministic": {}}'),
        ("evaluation.json", "[]"),
        ("evaluation.json", "[" * 100_000),
        ("origin.json", '{"commit": [1]}'),
        ("origin.json", ""),
        ("origin.json", '{"choices": []}'),
    ],
)
def test_a_damaged_file_is_named(write_run, file, content):
    folder = write_run("run", score=0.5)
    (folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    run = read_run(folder)
    assert isinstance(run, Run)
    assert run.state == "damaged"
    assert run.settings["method.name"] == "scratch"
    assert run.fault.startswith(f"{file} ")


def test_an_evaluation_may_lack_its_environment(write_run):
    folder = write_run("run", score=0.5)
    content = json.loads((folder / "evaluation.json").read_text()) | {"environment": None}
    (folder / "evaluation.json").write_text(json.dumps(content))
    assert cells([read_run(folder)])[0].remarks == ["one seed: the interval is over its episodes"]


def test_a_return_that_is_no_number_is_a_damage(write_run):
    run = read_run(write_run("run", score=math.nan))
    assert run.fault.startswith("evaluation.json ")
    assert "nan" in run.fault


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("method: [", []),
        ("method: {name: mcp}", ["task.name", "character.name", "stage.name", "seed", "training.total_frames"]),
        ("- 1", []),
        ("seed: ${nowhere}", ["task.name", "seed"]),
        ("a: &a [1]\nb: *a", []),
        (None, []),
    ],
)
def test_a_configuration_that_cannot_be_read_is_named(write_run, content, names):
    folder = write_run("run", score=0.5)
    (folder / "config.yaml").unlink() if content is None else (folder / "config.yaml").write_text(content)
    (damaged,) = find_runs([folder])[1]
    assert damaged.path == folder
    assert all(name in damaged.reason for name in ["config.yaml", *names]), damaged.reason


def test_a_run_that_is_to_take_no_steps_is_damaged(write_run):
    damaged = read_run(write_run("run", total_frames=0))
    assert isinstance(damaged, Damaged)
    assert "training.total_frames=0" in damaged.reason


def test_hidden_folders_hold_no_runs(write_run, tmp_path):
    write_run("run")
    shutil.copytree(tmp_path / "runs" / "run", tmp_path / "runs" / ".hydra")
    assert len(find_runs([tmp_path])[0]) == 1


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_path_without_a_run_is_an_error(tmp_path, name):
    (tmp_path / "empty").mkdir()
    refused(lambda: find_runs([tmp_path / name]), str(tmp_path / name))
