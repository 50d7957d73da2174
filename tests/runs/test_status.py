import io
import json
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from rich.console import Console

from torchrl_mcp.commands.status import main
from torchrl_mcp.runs import benchmark, experiment, lock
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.status import Status, look, overview, read_manifest, status, table, write_manifest

HEADER = "iteration,frames,seconds,episode/normalised_return,time/steps_per_second\n"


def make_run(folder, *, frames=0, total=1000, log=True, evaluation=None, episodes=None, saved=0):
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "checkpoints" / f"checkpoint-{saved:012d}.torchrl").touch()
    settings = "" if episodes is None else f"evaluation: {{episodes: {episodes}}}\n"
    (folder / "config.yaml").write_text(f"training: {{total_frames: {total}}}\n{settings}")
    if frames:
        (folder / "metrics.csv").write_text(HEADER + f"1,100,1.0,0.1,99.0\n2,{frames},2.0,0.25,50.0\n")
    if log:
        (folder / "train.log").touch()
    if evaluation is not None:
        content = {"deterministic": {"normalised_return": evaluation}}
        (folder / "evaluation.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def runs(tmp_path):
    """A run of each state, the running one locked as by a process that trains it."""
    make_run(tmp_path / "finished", frames=1000, evaluation=0.75)
    make_run(tmp_path / "killed", frames=600)
    alive = make_run(tmp_path / "alive", frames=400)
    planned = {tmp_path / name: 1000 for name in ("finished", "killed", "alive", "later")}
    write_manifest(planned, tmp_path / "multirun" / "benchmark-x.json")
    with lock.hold(alive):
        yield tmp_path


def test_a_run_is_waiting_running_stopped_or_done(runs):
    states = {one.folder.name: one.state for one in look(runs)}
    assert states == {"finished": "done", "killed": "stopped", "alive": "running", "later": "waiting"}


def test_a_run_that_is_running_has_a_speed_and_an_end(runs):
    one = status(runs / "alive")
    assert (one.frames, one.total, one.speed, one.normalised_return) == (400, 1000, 50.0, 0.25)
    assert one.remaining == pytest.approx((1000 - 400) / 50)


def test_no_time_remains_after_the_last_batch_which_may_exceed_the_total():
    assert Status(Path("run"), "running", frames=1_200, total=1_000, speed=50.0).remaining == 0.0


def test_the_return_is_that_of_the_evaluation_once_there_is_one(runs):
    assert status(runs / "finished").normalised_return == 0.75
    assert status(runs / "finished").remaining is None


def test_a_run_that_is_continued_is_not_done_because_it_was_evaluated_before(tmp_path):
    run = make_run(tmp_path / "run", frames=1000, evaluation=0.75)
    assert status(run).state == "done"
    (run / "config.yaml").write_text("training: {total_frames: 2000}\n")
    assert (status(run).state, status(run).total) == ("stopped", 2000)


def test_parts_of_a_benchmark_that_are_started_one_after_the_other_are_all_planned(tmp_path):
    manifest = tmp_path / "multirun" / "benchmark-x.json"
    write_manifest({tmp_path / "carry": 1000}, manifest)
    write_manifest({tmp_path / "heading": 500}, manifest)
    assert {one.folder.name: (one.state, one.total) for one in look(tmp_path)} == {
        "carry": ("waiting", 1000),
        "heading": ("waiting", 500),
    }


def test_parts_of_a_benchmark_that_are_started_together_are_all_planned(tmp_path):
    manifest = tmp_path / "multirun" / "benchmark-x.json"
    planned = {tmp_path / str(number): number for number in range(16)}
    with ThreadPoolExecutor(4) as processes:
        list(processes.map(lambda run: write_manifest({run: planned[run]}, manifest), planned))
    assert read_manifest(manifest) == planned


@pytest.mark.parametrize("blank", ["nan", ""])
def test_without_an_episode_that_ended_a_run_has_no_return(tmp_path, blank):
    run = make_run(tmp_path / "run", frames=400)
    metrics = run / "metrics.csv"
    metrics.write_text(metrics.read_text().replace("0.25", blank))
    one = status(run)
    assert (one.state, one.normalised_return) == ("stopped", None)
    assert shown(tmp_path).splitlines()[1].split()[4] == "-"


def test_a_run_is_done_after_its_steps_unless_an_evaluation_is_to_follow(tmp_path):
    assert status(make_run(tmp_path / "old", frames=1000, saved=1000, log=False)).state == "done"
    assert status(make_run(tmp_path / "none", frames=1000, saved=1000, episodes=0)).state == "done"
    assert status(make_run(tmp_path / "died", frames=1000, saved=1000, episodes=128)).state == "stopped"


def test_a_run_that_was_killed_between_its_last_row_and_its_last_checkpoint_is_not_done(tmp_path):
    assert status(make_run(tmp_path / "killed", frames=1000, saved=900, episodes=0)).state == "stopped"


def test_a_row_that_is_being_written_is_not_read(runs):
    with (runs / "alive" / "metrics.csv").open("a") as file:
        file.write("3,600,3.0,0.")
    assert status(runs / "alive").frames == 400


def test_the_table_shows_what_runs_first_and_counts_what_it_leaves_out(runs):
    console = Console(file=io.StringIO(), width=120)
    console.print(table(look(runs), runs, height=2))
    lines = console.file.getvalue().splitlines()
    assert lines[1].split() == ["alive", "running", "400/1,000", "50", "0.250", "12", "s"]
    assert lines[2].split()[:2] == ["killed", "stopped"]
    assert "1 running, 1 stopped, 1 done, 1 waiting; 2 not shown" in " ".join(" ".join(lines[3:]).split())


def test_without_a_terminal_there_is_a_line_for_each_change(runs, capsys, monkeypatch, tmp_path_factory):
    monkeypatch.setattr("torchrl_mcp.runs.status.INTERVAL", 0.01)
    whole = tmp_path_factory.mktemp("made") / "later"
    make_run(whole, frames=1000, evaluation=0.5)
    with overview(runs, {runs / name: 1000 for name in ("alive", "later")}):
        whole.rename(runs / "later")  # in one step: a run that is half made is damaged
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1:3] for line in lines] in (
        [["running", "alive"], ["done", "later"]],
        [["done", "later"], ["running", "alive"]],
    )
    assert lines[-1].endswith("(1 running, 1 done)")


def test_a_block_that_fails_ends_the_lines(runs, monkeypatch):
    monkeypatch.setattr("torchrl_mcp.runs.status.INTERVAL", 0.01)
    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt), overview(runs):
        raise KeyboardInterrupt
    assert threading.active_count() == before


def test_the_command_shows_a_folder(runs, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-status", str(runs)])
    main()
    assert "1 running, 1 stopped, 1 done, 1 waiting" in capsys.readouterr().out


def test_in_a_pipe_a_run_is_a_line_however_long_its_name(runs, capsys, monkeypatch):
    name = "a-long-name" * 20
    make_run(runs / name, frames=200)
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-status", str(runs)])
    monkeypatch.setenv("COLUMNS", "80")
    main()
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "long" in line]
    assert line.split()[:3] == [name, "stopped", "200/1,000"]


def test_a_run_of_a_benchmark_is_running_from_its_first_check_on(tmp_path, monkeypatch):
    run = tmp_path / "run"
    seen = []

    def check(cfg):
        seen.append([(one.state, (one.folder / "train.log").exists()) for one in look(tmp_path, {run: 128})])
        raise ValueError("a reason")

    monkeypatch.setattr(experiment, "require_all", check)
    with pytest.raises(ValueError, match="a reason"):
        benchmark.run(compose_run("preset=smoke", "logger=none", f"run_dir={run}"))
    assert seen == [[("running", True)]]
    assert status(run, 128).state == "stopped"


def test_a_folder_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-status", "nowhere"])
    with pytest.raises(SystemExit, match="no folder nowhere"):
        main()


def test_a_configuration_of_another_program_is_no_run(runs):
    files = runs / "finished" / "wandb" / "run-1" / "files"
    files.mkdir(parents=True)
    (files / "config.yaml").write_text("wandb_version: 1")
    assert {one.folder.name for one in look(runs)} == {"finished", "killed", "alive", "later"}


def test_a_damaged_run_is_a_line_that_says_so_and_the_others_are_shown(runs, tmp_path):
    damages = {
        "config.yaml": ["", "training: [", "training: {total_frames: many}", "a: &a [1]\nb: *a", "[" * 5000],
        "metrics.csv": ["iteration,frames\n1,many\n", "iteration,frames\n1,inf\n"],
        "evaluation.json": ["", "[]", "[" * 100_000, '{"deterministic": {"normalised_return": "high"}}'],
    }
    for file, contents in damages.items():
        for number, content in enumerate(contents):
            run = make_run(tmp_path / "bad" / f"{file}-{number}", frames=400)
            (run / file).write_text(content)
    (tmp_path / "multirun" / "benchmark-damaged.json").write_text('{"run": "many"}')
    found = {one.folder.name: one.state for one in look(runs)}
    assert [found.pop(f"{file}-{number}") for file in damages for number in range(len(damages[file]))] == [
        "damaged"
    ] * 11
    assert found.pop("benchmark-damaged.json") == "damaged"
    assert found == {"finished": "done", "killed": "stopped", "alive": "running", "later": "waiting"}
    assert "12 damaged" in shown(runs)


def test_brackets_in_the_name_of_a_folder_are_shown(runs, tmp_path):
    for name in ("freeze-[]", "freeze-[primitives]", "[", "[x]"):
        make_run(tmp_path / name, frames=400)
    make_run(tmp_path / "[" / "x]", frames=400)
    text = shown(runs)
    for name in ("freeze-[]", "freeze-[primitives]", "[x]", "[/x]"):
        assert f"{name} " in text


def shown(runs):
    console = Console(file=io.StringIO(), width=120)
    console.print(table(look(runs), runs))
    return console.file.getvalue()
