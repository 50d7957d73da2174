"""The search of settings at equal processor time."""

import csv
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_mcp.runs.configuration import compose_run

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def search(monkeypatch):
    """The search of settings, which needs Optuna only to propose them."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    monkeypatch.delitem(sys.modules, "search", raising=False)
    return importlib.import_module("search")


def test_a_candidate_is_trained_for_its_cpu_seconds_evaluated_and_not_trained_again(
    search, command, tmp_path, monkeypatch
):
    cpu_time = sys.modules["cpu_time"]
    monkeypatch.setattr(
        cpu_time.subprocess, "run", lambda words, **_: command("evaluate", *words[1:])
    )  # no new process
    tiny = "preset=smoke training.frames_per_batch=128 task.evaluation.max_episode_steps=10"
    monkeypatch.setattr(cpu_time, "EPISODES", "4")
    monkeypatch.setattr(search, "STEPS_PER_CHECKPOINT", 128)
    words = ["heading", "scratch", "--minutes", "0.05", "--seeds", "7", "--candidate", f"tiny={tiny}"]
    for _ in range(2):
        search.main([*words, "--root", str(tmp_path), "--results", str(tmp_path)])
    with (tmp_path / "heading-scratch-candidates.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["trial"], row["seed"], row["settings"]) == ("tiny", "7", tiny)
    assert float(row["cpu_seconds"]) >= 3.0
    assert int(row["steps"]) > 0
    returns = [float(row[f"{mode}_return"]) for mode in ("deterministic", "stochastic")]
    assert float(row["score"]) == pytest.approx(sum(returns) / 2)
    with pytest.raises(SystemExit, match="tiny"):
        search.main([*words[:3], "1", *words[4:], "--root", str(tmp_path), "--results", str(tmp_path)])


def test_two_searches_that_share_a_table_keep_each_other_s_rows(search, tmp_path):
    tables = [search.Table(tmp_path / "table.csv") for _ in range(2)]
    for name, table in zip(("first", "second"), tables, strict=True):
        table.write(name, 100, [], {"cpu_seconds": 60.0, "score": 1.0})
    assert [row["trial"] for row in tables[0].rows] == ["first", "second"]


def test_every_method_is_searched_over_settings_that_it_has(search):
    for method, noises in search.NOISE.items():
        for settings in noises.values():
            words = [*search.settings_of("dribble", method), *sys.modules["cpu_time"].FIXED, *settings.split()]
            compose_run(*words, *search.batch_words(32, 1024, minibatches=8, passes=4), "stage.gamma=0.995")


@pytest.mark.parametrize(
    ("method", "settings", "iterations"),
    [
        ("mcp", [], 4),  # 65,536 steps in batches of 16,384
        ("mcp", ["training.num_envs=32", "training.frames_per_batch=1024"], 64),
        ("hierarchical", [], 2),  # its batches have eight times 4,096 steps
    ],
)
def test_checkpoints_are_as_many_steps_apart_whatever_the_batch_is(search, method, settings, iterations):
    words = [*search.settings_of("dribble", method), "training.minibatch_size=512", *settings]
    assert search.interval(words) == f"checkpoint_interval={iterations}"


def test_a_row_of_another_commit_is_not_taken_for_that_of_a_candidate(search, tmp_path, monkeypatch):
    table = search.Table(tmp_path / "table.csv")
    table.write("default", 100, [], {"cpu_seconds": 60.5})
    assert table.contains("default", 100, [], 60)
    assert not table.contains("default", 101, [], 60)
    for seconds in (30, 90):
        with pytest.raises(SystemExit, match="default"):
            table.contains("default", 100, [], seconds)
    monkeypatch.setattr(search, "about", lambda: {"commit": "another"})
    with pytest.raises(SystemExit, match="another commit"):
        table.contains("default", 100, [], 60)


def test_a_row_of_a_machine_with_other_packages_is_appended_in_the_columns_of_the_table(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(BENCHMARKS)
    append = importlib.import_module("report").append
    for row in ({"run": 1, "numpy": "2"}, {"run": 2, "torch": "3"}):
        append(tmp_path / "table.csv", row)
    assert (tmp_path / "table.csv").read_text().split() == ["run,numpy", "1,2", "2,"]


def test_rows_that_processes_append_at_once_have_one_header(tmp_path):
    path = tmp_path / "table.csv"
    code = "import sys, report; [report.append(report.Path(sys.argv[1]), {'run': n}) for n in range(200)]"
    processes = [subprocess.Popen([sys.executable, "-c", code, path], cwd=BENCHMARKS) for _ in range(3)]
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    head, *rows = path.read_text().split()
    assert head == "run"
    assert sorted(map(int, rows)) == sorted([*range(200)] * 3)


def test_candidates_of_imitation_begin_from_the_start(search):
    cfg = compose_run(*search.settings_of("imitation", "mcp"))
    assert (cfg.stage.name, cfg.pretrained) == ("pretrain", None)
    with pytest.raises(SystemExit):
        search.main(["imitation", "mcp", "--minutes", "1"])
