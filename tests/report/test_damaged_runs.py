import json
import math
import random
import sys
from datetime import UTC, datetime

import pytest

from torchrl_mcp.commands.report import main
from torchrl_mcp.report.page import report
from torchrl_mcp.report.results import find_runs


@pytest.mark.parametrize("progress", [0.0, 0.5])
def test_a_run_that_has_just_begun_makes_a_report(write_run, parse_page, progress):
    folder = write_run("run", progress=progress, preset=None)
    html = report(*find_runs([folder]), moment=datetime.now(UTC))["report.html"]
    assert f"{progress:.0%} trained" in parse_page(html).text


def test_damaged_folders_alone_make_a_report(write_run, parse_page):
    folder = write_run("run")
    (folder / "config.yaml").write_text("[")
    assert "1 damaged" in parse_page(report(*find_runs([folder]), moment=datetime.now(UTC))["report.html"]).text


def test_a_run_whose_metrics_end_in_a_short_line_is_damaged_and_the_report_is_made(write_run, tmp_path):
    write_run("whole", score=0.5)
    with (write_run("short", seed=1, score=0.5) / "metrics.csv").open("a") as file:
        file.write("11,1000\n")
    pages = report(*find_runs([tmp_path]), moment=datetime.now(UTC))
    assert "1 damaged" in pages["report.md"]


JUNK = [None, True, -1, 1e400, math.nan, "", "many", "<b>", [], [[]], {}, {"a": {}}, "9" * 400]


def spoil(content, generator):
    """Replace, remove or add a value somewhere in a tree of objects."""
    inside = [content] + [value for value in content.values() if isinstance(value, dict)]
    target = generator.choice(inside)
    key = generator.choice([*target, "surprise"]) if target else "surprise"
    if generator.random() < 0.2:
        target.pop(key, None)
    else:
        target[key] = generator.choice(JUNK)


def test_however_the_files_of_runs_are_damaged_the_others_are_reported(write_run, tmp_path):
    generator = random.Random(0)
    write_run("whole", score=0.625, method="scratch")
    for number in range(150):
        folder = write_run(f"damaged{number}", score=0.5, seed=number + 1)
        file = folder / ("evaluation.json", "origin.json")[number % 2]
        content = json.loads(file.read_text())
        for _ in range(1 + number % 3):
            spoil(content, generator)
        file.write_text(json.dumps(content))
    runs, damaged = find_runs([tmp_path])
    assert len(runs) + len(damaged) == 151
    pages = report(runs, damaged, moment=datetime.now(UTC))
    faulty = [run for run in runs if run.state == "damaged"]
    assert 30 < len(faulty) < 150
    assert all(str(run.path) in pages["report.md"] for run in faulty)
    assert [run.state for run in runs if run.path.name == "whole"] == ["complete"]


@pytest.mark.parametrize(("key", "value"), [("normalised_return", math.nan), ("interval", [0.25, math.inf])])
def test_a_run_whose_evaluation_is_not_finite_is_damaged(write_run, key, value):
    folder = write_run("run", score=0.5)
    content = json.loads((folder / "evaluation.json").read_text())
    content["stochastic"][key] = value
    (folder / "evaluation.json").write_text(json.dumps(content))
    (run,) = find_runs([folder])[0]
    assert run.state == "damaged"


def test_what_the_environment_holds_does_not_get_into_a_report(write_run, tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "swordfish")
    write_run("received", score=0.5, method__title="${oc.env:SECRET}")
    pages = report(*find_runs([tmp_path]), moment=datetime.now(UTC))
    assert "swordfish" not in "".join(pages.values())


def test_the_command_writes_both_pages_and_the_picture(varied_runs, tmp_path, monkeypatch, capsys):
    (note := tmp_path / "note.txt").touch()  # as the shell's runs/* may match
    output = tmp_path / "a" / "b"
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-report", str(varied_runs), str(note), "--output", str(output)])
    main()
    assert capsys.readouterr().out.startswith("16 runs, 12 complete, 1 not evaluated, 1 unfinished, 2 damaged: ")
    found = sorted(path.name for path in output.iterdir())
    assert found == ["report.html", "report.md", "table_2.png", "table_2.svg"]


@pytest.mark.parametrize("folder", ["nowhere", "empty"])
def test_the_command_names_a_folder_without_runs(tmp_path, monkeypatch, folder):
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-report", str(tmp_path / folder)])
    with pytest.raises(SystemExit, match=folder):
        main()
