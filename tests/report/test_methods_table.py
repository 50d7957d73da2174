"""The benchmark's table of methods, of runs whose numbers are made up."""

import csv
import runpy
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks/comparison.py"


def tabulate(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, arguments)])
    runpy.run_path(str(SCRIPT), run_name="__main__")


@pytest.fixture
def runs(tmp_path, run_writers):
    root = tmp_path / "runs"
    write, write_mcp = run_writers(root)
    for name, steps in (("3", 3_000_000), ("10", 10_000_000)):
        budget = {"budget__pretrain": steps}
        write_mcp(f"source{name}", stage="pretrain", task="imitation", total_frames=steps, score=0.5, **budget)
        write_mcp(f"gate{name}", score=0.08 * int(name), pretrained=str(root / f"source{name}"), **budget)
    write("seed0", score=0.8, budget__pretrain=3_000_000)
    write("seed1", score=0.9, seed=1, budget__pretrain=3_000_000)
    write("unfinished", seed=2, progress=0.5, budget__pretrain=3_000_000)
    return root


def test_every_cell_stands_beside_the_papers_with_what_it_took(runs, tmp_path, monkeypatch, capsys):
    tabulate(monkeypatch, runs, "--output", tmp_path)
    head, rule, *lines = capsys.readouterr().out.splitlines()
    names = [name.strip() for name in head.strip("|").split("|")]
    assert names == ["method", "seeds", "deterministic", "fallen", "stochastic", "paper"]
    assert set(rule) == {"|", "-"}
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in lines] == [
        ["Scratch", "2", "0.850 +- 0.071", "25%", "0.750 +- 0.071", "0.927 +- 0.032"],
        ["MCP", "1", "0.240", "25%", "0.140", "0.976 +- 0.002"],
        ["MCP, 10 M", "1", "0.800", "25%", "0.700", "0.976 +- 0.002"],
    ]
    with (tmp_path / "heading_biped_methods.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = {(row["method"], row["seed"]): (row["pretraining_steps"], row["steps"], row["seconds"]) for row in rows}
    assert found == {
        ("Scratch", "0"): ("0", "1000", "10"),
        ("Scratch", "1"): ("0", "1000", "10"),
        ("MCP, 10 M", "0"): ("10000000", "1000", "10"),
        ("MCP", "0"): ("3000000", "1000", "10"),
    }
    assert {row["commit"] for row in rows} == {"abc1234"}


def test_curves_are_of_those_that_were_pretrained_for_as_long(runs, tmp_path, monkeypatch):
    tabulate(monkeypatch, runs, "--output", tmp_path)
    with (tmp_path / "heading_biped_methods_curves.csv").open(newline="") as file:
        assert {row["label"] for row in csv.DictReader(file)} == {"Scratch", "MCP"}
    assert (tmp_path / "heading_biped_methods_curves.png").stat().st_size > 0


def test_a_task_without_complete_runs_is_named(runs, tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        tabulate(monkeypatch, runs, "--task", "dribble", "--output", tmp_path)
    assert f"{runs} holds no complete run of dribble biped, transfer" in capsys.readouterr().err
