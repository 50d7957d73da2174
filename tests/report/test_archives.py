"""Table 2 and the table of ablations, of runs whose numbers are made up, and the published tables."""

import csv
import importlib
import json
import re
import runpy
import sys
import tarfile
from collections import defaultdict
from pathlib import Path
from statistics import mean

import pytest
from archives import unpack
from omegaconf import OmegaConf

from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.results import find_runs

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "benchmarks/results"


def tabulate(monkeypatch, *arguments, script="table2"):
    path = ROOT / "benchmarks" / f"{script}.py"
    monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
    monkeypatch.syspath_prepend(str(path.parent))
    runpy.run_path(str(path), run_name="__main__")


def cells_of(markdown):
    """The cells of a Markdown table, a list for each line, without the rule."""
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in (lines[0], *lines[2:])]


def normalised_return(evaluations):
    return mean(each["normalised_return"] for each in evaluations)


def add_metrics(run, metrics):
    """Give an evaluation the metrics of a task."""
    path = run / "evaluation.json"
    found = json.loads(path.read_text())
    for mode in ("deterministic", "stochastic"):
        found[mode]["metrics"] = metrics
    path.write_text(json.dumps(found))


@pytest.fixture
def archive(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("archive")


def learn(run, column, best):
    """Let a quantity grow with time to its best value in ten minutes of a run."""
    rows = [{"iteration": i, "frames": 10 * i, "seconds": 6 * i, column: best * i / 100} for i in range(1, 101)]
    rows = [{"episode/count": 1, "episode/normalised_return": 0.5} | row for row in rows]
    with (run / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def times_of(archive, folder, name):
    """The minutes in a column of the table of a task, by method."""
    found = cells(find_runs([folder])[0])
    times = zip(found, archive.times(found), strict=True)
    return {cell.method: float(row[name]) if row[name] else None for cell, row in times}


def test_minutes_until_four_fifths_of_the_best_return_are_those_of_the_learning_curve(write_run, archive, tmp_path):
    learn(write_run("best", score=0.9), "episode/normalised_return", best=1.0)
    learn(write_run("worse", method="finetune", score=0.5), "episode/normalised_return", best=0.7)
    times = times_of(archive, tmp_path / "runs", "to 0.8")
    assert times["scratch"] == pytest.approx(8.0, abs=0.2)
    assert times["finetune"] is None


def test_seeds_without_common_steps_have_no_learning_curve_and_no_minutes(write_run, archive, tmp_path):
    for seed, returns in enumerate([("0.5", "nan"), ("nan", "0.5")]):
        run = write_run(f"seed{seed}", seed=seed, score=0.5)
        header, *_ = (run / "metrics.csv").read_text().split()
        (run / "metrics.csv").write_text("{}\n1,100,1,1,{}\n2,1000,10,1,{}\n".format(header, *returns))
    assert times_of(archive, tmp_path / "runs", "to 0.8") == {"scratch": None}


def test_in_tasks_that_define_success_it_is_the_minutes_until_half_of_the_best_share_of_successes(
    write_run, archive, tmp_path
):
    for method, best in (("scratch", 0.001), ("finetune", 0.0006), ("moe", None)):
        run = write_run(method, task="carry", method=method, score=0.5)
        add_metrics(run, {"success": 0.5})
        if best:
            learn(run, "task/success", best)
    times = times_of(archive, tmp_path / "runs", "to half")
    assert times["scratch"] == pytest.approx(5.0, abs=0.2)
    assert times["finetune"] == pytest.approx(5.0 / 0.6, abs=0.2)
    assert times["moe"] is None  # archived without successes


def test_an_archive_without_successes_has_no_time_to_half_of_them(write_run, archive, tmp_path):
    add_metrics(write_run("old", task="carry", score=0.5), {"success": 0.5})
    (row,) = archive.times(cells(find_runs([tmp_path / "runs"])[0]))
    assert list(row) == ["minutes", "commit"]


@pytest.fixture
def results(tmp_path, run_writers, monkeypatch):
    root = tmp_path / "runs"
    write, write_mcp = run_writers(root)
    add_metrics(write_mcp("source", stage="pretrain", task="imitation", score=0.5), {"tracking_error": 0.05})
    write_mcp("gate", score=0.9, pretrained=str(root / "source"))
    write_mcp("long", score=0.95, total_frames=4000, pretrained=str(root / "source"))
    for seed, score in enumerate((0.8, 0.9)):
        write(f"long{seed}", score=score, seed=seed, total_frames=4000)
        write(f"short{seed}", score=score - 0.5, seed=seed)
    write("unfinished", seed=2, progress=0.5)
    tabulate(monkeypatch, root, "--output", tmp_path / "results")
    return tmp_path / "results"


def test_our_numbers_stand_above_the_papers_with_their_seeds(results):
    head, heading, paper, *others = cells_of((results / "table.md").read_text())
    found = dict(zip(head, zip(heading, paper, strict=True), strict=True))
    assert found == {
        "": ("heading, Biped", "*paper*"),
        "Scratch": ("0.850 (2)", "*0.927*"),
        "Scratch, short": ("0.350 (2)", ""),
        "Finetune": ("", "*0.970*"),
        "Hierarchical": ("", "*0.834*"),
        "Option critic": ("", "*0.952*"),
        "MOE": ("", "*0.918*"),
        "Latent space": ("", "*0.970*"),
        "MCP": ("0.900 (1)", "*0.976*"),  # not 0.950, which took four times as many steps
    }
    assert len(others) == 14
    assert not any("(" in cell for row in others for cell in row)  # no runs of the other rows


def test_a_task_that_is_learned_in_both_stages_has_two_tables(tmp_path, run_writers, monkeypatch):
    _, write_mcp = run_writers(tmp_path / "runs")
    write_mcp("source", stage="pretrain", task="holdout", character="ant", score=0.5)
    write_mcp("gate", task="holdout", character="ant", score=0.8, pretrained=str(tmp_path / "runs/source"))
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path)
    for name, score in (("holdout_ant_pretrain", "0.500"), ("holdout_ant", "0.800")):
        head, row = cells_of((tmp_path / f"{name}.md").read_text())
        assert dict(zip(head, row, strict=True))["deterministic"] == score
        assert (tmp_path / f"{name}.png").exists()


def test_every_task_has_a_table_and_curves(results):
    head, *rows = cells_of((results / "heading_biped.md").read_text())
    found = [dict(zip(head, row, strict=True)) for row in rows]
    assert [row[""] for row in found] == [f"{method}, 0.0 M steps" for method in ("Scratch", "Scratch", "MCP", "MCP")]
    assert [row["steps"] for row in found] == ["1,000", "4,000", "1,000", "4,000"]
    assert [row["deterministic"] for row in found] == ["0.350 ± 0.071", "0.850 ± 0.071", "0.900", "0.950"]
    assert {row["fallen"] for row in found} == {"25%"}
    head, row = cells_of((results / "imitation_biped.md").read_text())
    assert dict(zip(head, row, strict=True))["completed"] == "75%"
    assert (results / "heading_biped.png").stat().st_size > 0
    with (results / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 14  # seven runs in two modes
    assert {row["commit"] for row in rows} == {"abc1234"}


def test_a_run_that_goes_on_for_longer_is_in_the_table_and_not_among_the_curves(tmp_path, run_writers, monkeypatch):
    write, write_mcp = run_writers(tmp_path / "runs")
    write("scratch", score=0.8, total_frames=4_000_000)
    for name, steps in (("short", 1_000_000), ("long", 4_000_000)):
        write_mcp(name, score=0.9, total_frames=steps)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path / "results")
    names = [row[0] for row in cells_of((tmp_path / "results/heading_biped.md").read_text())[1:]]
    assert names == ["Scratch", "MCP, 1.0 M steps", "MCP, 4.0 M steps"]
    drawn = (tmp_path / "results/heading_biped.svg").read_text()
    assert [f"<!-- {name} -->" in drawn for name in names] == [True, True, False]


def test_a_seed_that_is_stored_twice_is_one_seed_of_a_table(tmp_path, run_writers, monkeypatch):
    _, write_mcp = run_writers(tmp_path / "runs")
    for name, seed, score in (("a", 0, 0.4), ("b", 0, 0.4), ("c", 1, 0.8)):
        write_mcp(name, seed=seed, score=score)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path / "results")
    assert "0.600 (2)" in (tmp_path / "results/table.md").read_text()
    head, row = cells_of((tmp_path / "results/heading_biped.md").read_text())
    found = dict(zip(head, row, strict=True))
    assert (found["seeds"], found["deterministic"]) == ("2", "0.600 ± 0.283")
    assert "MCP (2 seeds)" in (tmp_path / "results/heading_biped.svg").read_text()


def test_the_archive_gives_the_same_results_again(results, tmp_path, monkeypatch):
    again = tmp_path / "again"
    again.mkdir()
    (again / "runs.tar.xz").write_bytes((results / "runs.tar.xz").read_bytes())
    tabulate(monkeypatch, "--output", again)
    for name in ("table.md", "heading_biped.md", "imitation_biped.md", "runs.csv"):
        assert (again / name).read_text() == (results / name).read_text()
    kept = unpack(results / "runs.tar.xz", tmp_path / "kept")
    assert not any(str(tmp_path) in path.read_text() for path in kept.rglob("*.*"))


def test_the_name_of_the_folder_of_runs_may_occur_in_their_files(tmp_path, run_writers, monkeypatch):
    write, _ = run_writers(tmp_path)
    run = write("run", score=0.5)
    monkeypatch.chdir(tmp_path)
    tabulate(monkeypatch, ".", "--output", "results")
    kept = unpack(tmp_path / "results/runs.tar.xz", tmp_path / "kept")
    assert (kept / "run/evaluation.json").read_text() == (run / "evaluation.json").read_text()
    assert "run_dir: runs/run\n" in (kept / "run/config.yaml").read_text()


def test_an_archive_stays_until_complete_runs_replace_it(tmp_path, run_writers, monkeypatch):
    write, _ = run_writers(tmp_path)
    write("done/run", score=0.5, preset=None)  # an older run, without origin.json
    write("begun/run", progress=0.5)
    tabulate(monkeypatch, tmp_path / "done", "--output", tmp_path)
    kept = (tmp_path / "runs.tar.xz").read_bytes()
    with pytest.raises(SystemExit, match="begun"):
        tabulate(monkeypatch, tmp_path / "begun", "--output", tmp_path)
    write("other/run", score=0.5)
    monkeypatch.setattr(tarfile.TarFile, "addfile", interrupt)
    with pytest.raises(KeyboardInterrupt):
        tabulate(monkeypatch, tmp_path / "other", "--output", tmp_path)
    assert (tmp_path / "runs.tar.xz").read_bytes() == kept


def interrupt(*_):
    raise KeyboardInterrupt


def test_a_run_behind_a_link_is_archived_where_the_link_is(tmp_path, run_writers, monkeypatch):
    run_writers(tmp_path)[0]("elsewhere/run", score=0.5)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/linked").symlink_to(tmp_path / "elsewhere")
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path)
    assert (unpack(tmp_path / "runs.tar.xz", tmp_path / "kept") / "linked/run/config.yaml").exists()


def test_a_run_without_an_episode_of_full_length_is_in_the_tables_and_has_no_curve(tmp_path, run_writers, monkeypatch):
    write, write_mcp = run_writers(tmp_path / "runs")
    for folder in (write("heading", score=0.5), write("carry", task="carry", score=0.25)):
        metrics = folder / "metrics.csv"
        metrics.write_text(metrics.read_text().replace(",1,0.5", ",1,nan"))
    write_mcp("mcp", score=0.75)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path)
    head, *rows = cells_of((tmp_path / "heading_biped.md").read_text())
    found = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    assert (found["Scratch"]["deterministic"], found["Scratch"]["to 0.8"]) == ("0.500", "")
    drawn = (tmp_path / "heading_biped.svg").read_text()
    assert [f"<!-- {name} -->" in drawn for name in ("Scratch", "MCP")] == [False, True]
    assert "0.250" in (tmp_path / "carry_biped.md").read_text()
    assert not (tmp_path / "carry_biped.svg").exists()


def test_a_short_run_of_one_method_leaves_the_curves_of_the_others(tmp_path, run_writers, monkeypatch):
    write, write_mcp = run_writers(tmp_path / "runs")
    write("trial", method="finetune", score=0.2)
    write_mcp("mcp", score=0.9, total_frames=4000)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path)
    assert "<!-- MCP -->" in (tmp_path / "heading_biped.svg").read_text()


def test_without_runs_and_archive_the_script_says_what_it_needs(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        tabulate(monkeypatch, "--output", tmp_path)
    assert "give the folder of the runs" in capsys.readouterr().err


def test_the_table_of_ablations_has_a_row_for_each_variant(tmp_path, run_writers, monkeypatch):
    _, write_mcp = run_writers(tmp_path / "runs")
    for name, score, settings in (
        ("eight", 0.9, {"exploration__name": "weights"}),
        ("four", 0.7, {"exploration__name": "weights", "num_primitives": 4}),
        ("additive", 0.6, {"exploration__name": "weights", "mixer__name": "additive"}),
        ("action", 0.5, {}),
        ("both", 0.8, {"transfer__freeze": ["observation_normaliser"]}),
    ):
        for seed, change in enumerate((0.0, 0.1)):
            write_mcp(f"{name}{seed}", seed=seed, score=score + change, **settings)
    for name, settings in (("source", {}), ("source_of_four", {"num_primitives": 4})):
        add_metrics(
            write_mcp(name, stage="pretrain", task="imitation", score=0.5, **settings), {"tracking_error": 0.05}
        )
    write_mcp("dribbling", task="dribble", score=0.3)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path / "results", script="ablations")
    assert cells_of((tmp_path / "results/table.md").read_text()) == [
        ["num_primitives", "mixer", "exploration", "trained", "imitation, completed", "heading", "dribble"],
        ["4", "multiplicative", "weights", "gate", "75%", "0.750 (2)", ""],
        ["8", "multiplicative", "weights", "gate", "75%", "0.950 (2)", ""],
        ["8", "multiplicative", "action", "gate", "75%", "0.550 (2)", "0.300 (1)"],
        ["8", "multiplicative", "action", "gate and primitives", "75%", "0.850 (2)", ""],
        ["8", "additive", "weights", "gate", "", "0.650 (2)", ""],
    ]
    names = [row[0] for row in cells_of((tmp_path / "results/heading_biped.md").read_text())[1:]]
    assert sorted(names) == [
        "MCP, exploration=action",
        "MCP, exploration=weights",
        "MCP, mixer=additive, exploration=weights",
        "MCP, num_primitives=4, exploration=weights",
        "MCP, trained=gate and primitives, exploration=action",
    ]


def test_ablations_of_several_characters_have_a_column_each_and_other_methods_none(tmp_path, run_writers, monkeypatch):
    write, write_mcp = run_writers(tmp_path / "runs")
    for character, score in (("biped", 0.5), ("humanoid", 0.25)):
        write_mcp(character, task="dribble", character=character, score=score)
    source = write_mcp("source", stage="pretrain", task="imitation", character="humanoid", score=0.5)
    add_metrics(source, {"tracking_error": 0.05})
    write("scratch", task="dribble", score=0.125)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path, script="ablations")
    head, row = cells_of((tmp_path / "table.md").read_text())
    assert dict(zip(head[4:], row[4:], strict=True)) == {
        "imitation, completed, biped": "",
        "imitation, completed, humanoid": "75%",
        "dribble, biped": "0.500 (1)",
        "dribble, humanoid": "0.250 (1)",
    }


def test_runs_of_one_variant_that_differ_in_their_length_have_no_common_row(tmp_path, run_writers, monkeypatch):
    _, write_mcp = run_writers(tmp_path / "runs")
    for steps in (1_000_000, 3_000_000):
        write_mcp(f"{steps}", score=0.5, total_frames=steps)
    with pytest.raises(SystemExit, match=r"MCP, 1\.0 M steps and MCP, 3\.0 M steps are one row"):
        tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path, script="ablations")


def test_two_pretrainings_of_one_variant_have_no_common_row(tmp_path, run_writers, monkeypatch):
    _, write_mcp = run_writers(tmp_path / "runs")
    for steps in (1_000_000, 3_000_000):
        source = write_mcp(f"{steps}", stage="pretrain", task="imitation", score=0.5, total_frames=steps)
        add_metrics(source, {"tracking_error": 0.05})
    write_mcp("transfer", score=0.5)
    with pytest.raises(SystemExit, match=r"MCP, 1\.0 M steps and MCP, 3\.0 M steps are one row"):
        tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path, script="ablations")


def test_pretrainings_of_other_lengths_are_told_apart(tmp_path, run_writers, monkeypatch):
    _, write_mcp = run_writers(tmp_path / "runs")
    for name, steps in (("short", 3_000_000), ("long", 10_000_000)):
        write_mcp(name, score=0.9, budget__pretrain=steps)
    tabulate(monkeypatch, tmp_path / "runs", "--output", tmp_path / "results")
    names = [row[0] for row in cells_of((tmp_path / "results/heading_biped.md").read_text())[1:]]
    assert names == ["MCP, pre-trained 3 M", "MCP, pre-trained 10 M"]


def skill_in(title, score):
    """The skill of the method with a return, in the table of a row such as ``dribble, T-Rex``."""
    name = title.lower().replace(", ", "_").replace("-", "")
    head, *rows = cells_of((PUBLISHED / f"table2/{name}.md").read_text())
    (skill,) = {row[head.index("skill")] for row in rows if row[head.index("deterministic")].startswith(f"{score} ")}
    return skill


def test_the_readme_has_the_short_form_of_table_2():
    """Its cells are those of the long form, with skills: MCP, the best of the others that pre-train, and scratch."""
    summary = (PUBLISHED / "table2/summary.md").read_text()
    assert summary in (ROOT / "README.md").read_text()
    head, *rows = cells_of(summary)
    assert len(head) <= 6
    columns, *lines = cells_of((PUBLISHED / "table2/table.md").read_text())
    assert len(rows) == len(lines) / 2
    for shown, ours, paper in zip(rows, lines[::2], lines[1::2], strict=True):
        row = dict(zip(columns, ours, strict=True))
        others = {name: cell for name, cell in list(row.items())[3:-1] if cell}
        best = max(others, key=lambda name: float(others[name][:5]))
        expected = [(name, re.match(r"([\d.]+)(?:, (\d+%))? \((\d)\)", row[name])) for name in ("MCP", best, "Scratch")]
        cells = [
            f"{found[2]}, skill {skill_in(row[''], found[1])} ({found[1]})" if found[2] else found[1]
            for _, found in expected
        ]
        cells[1] = f"{best} {cells[1]}"
        seeds = ", ".join(found[3] for _, found in expected)
        assert shown == [row[""], *cells, paper[-1].strip("*"), seeds]


def test_the_published_ablations_make_their_table(tmp_path):
    """Each cell has the mean of the evaluations in the archive whose configurations have the row's choices."""
    runs, found = unpack(PUBLISHED / "ablations/runs.tar.xz", tmp_path), defaultdict(list)
    for path in runs.rglob("evaluation.json"):
        settings = OmegaConf.load(path.with_name("config.yaml"))
        if settings.stage.name == "transfer":
            trained = "gate" if "primitives" in settings.transfer.freeze else "gate and primitives"
            chosen = (str(settings.num_primitives), settings.mixer.name, settings.exploration.name, trained)
            found[*chosen, settings.task.name].append(json.loads(path.read_text())["deterministic"])
    head, *rows = cells_of((PUBLISHED / "ablations/table.md").read_text())
    shown = {(*row[:4], task): cell for row in rows for task, cell in zip(head[5:], row[5:], strict=True) if cell}
    assert shown.keys() == found.keys()
    for key, cell in shown.items():
        share = f", {mean(each['metrics']['success'] for each in found[key]):.0%}" if key[-1] == "dribble" else ""
        assert cell == f"{normalised_return(found[key]):.3f}{share} ({len(found[key])})"


def test_the_published_table_of_the_cheetah_has_the_means_of_the_archived_evaluations(tmp_path):
    folder = unpack(PUBLISHED / "cheetah" / "runs.tar.xz", tmp_path)
    returns = defaultdict(list)
    for path in folder.rglob("evaluation.json"):
        stage, method = path.relative_to(folder).parts[1:3]
        returns[stage, method].append(json.loads(path.read_text())["deterministic"])
    head, *lines = cells_of((PUBLISHED / "cheetah" / "table.md").read_text())
    assert len(lines) == 7
    for line in lines:
        row = dict(zip(head, line, strict=True))
        method = row[""].lower().replace(" ", "_").replace("-", "_")
        for stage, column in (("pretrain", "at the seven speeds"), ("transfer", "at the new speeds")):
            found = returns[stage, method]
            assert row[column].partition(" ")[0] == (f"{normalised_return(found):.3f}" if found else "")
            assert len(found) == (0 if (stage, method) == ("pretrain", "scratch") else 3)
