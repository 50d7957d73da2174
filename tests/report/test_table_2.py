"""Table 2 of the published runs, and its picture: what its bars are as long as."""

import csv
import json
import re
from collections import defaultdict
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from statistics import mean

import pytest

from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.page import report
from torchrl_mcp.report.results import find_runs
from torchrl_mcp.report.table_2 import describe, draw_over_rows, draw_table_2, over_rows

PUBLISHED = Path(__file__).parents[2] / "benchmarks/results/table2"
ROWS = [
    *("heading, Biped", "heading, Humanoid", "heading, T-Rex", "carry, Biped"),
    *("dribble, Biped", "dribble, Humanoid", "dribble, T-Rex", "holdout, Ant"),
]


def drawn(folder):
    return draw_table_2(cells(find_runs([folder])[0]))


def bars(panel):
    """Lengths of the bars of a panel by method: ours is above the name, the paper's below it."""
    names = [label.get_text() for label in panel.figure.axes[0].get_yticklabels()]
    found = defaultdict(dict)
    for bar in panel.patches:
        middle = bar.get_y() + bar.get_height() / 2
        method = round(middle)
        found[names[method]]["ours" if middle < method else "paper"] = bar.get_width()
    return dict(found)


def mean_return(evaluations):
    return mean(each["normalised_return"] for each in evaluations)


def test_the_published_runs_make_table_2(published, tmp_path):
    """The table has the mean of the evaluations in the archive, cell by cell."""
    folder, runs = published
    evaluations = defaultdict(lambda: defaultdict(list))
    for path in folder.rglob("evaluation.json"):
        settings = path.with_name("config.yaml").read_text()
        task, character, method, stage, exploration = (
            re.search(rf"^{group}:\n(?:  .*\n)*?  name: (\w+)", settings, re.MULTILINE)[1]
            for group in ("task", "character", "method", "stage", "exploration")
        )
        if stage == "transfer":
            steps = int(re.search(r"total_frames: (\d+)", settings)[1])
            pretraining = re.search(r"^budget:\n(?:  .*\n)*?  pretrain:(.*(?:\n    .*)*)", settings, re.MULTILINE)[1]
            found = json.loads(path.read_text())["deterministic"]
            evaluations[task, character, method, steps][exploration, pretraining].append(found)
    table = (PUBLISHED / "table.md").read_text().splitlines()
    head, _, *lines = ([cell.strip() for cell in line.strip("|").split("|")] for line in table if line.startswith("|"))
    shown = {
        (line[0], column): cell for line in lines[::2] for column, cell in zip(head[1:], line[1:], strict=True) if cell
    }
    assert shown
    for (row, column), cell in shown.items():
        task, character = row.lower().replace("t-rex", "trex").split(", ")
        method = column.removesuffix(", short").lower().replace(" ", "_")
        budgets = {steps: kinds for (*named, steps), kinds in evaluations.items() if named == [task, character, method]}
        kinds = budgets[max(budgets) if column == "Scratch" else min(budgets)].values()
        best, seeds = max(((mean_return(seeds), seeds) for seeds in kinds), key=itemgetter(0))
        successes = [each["metrics"]["success"] for each in seeds if task in ("carry", "dribble")]
        share = f", {mean(successes):.0%}" if successes else ""
        assert cell == f"{best:.3f}{share} ({len(seeds)})"
    page = report(runs, [], moment=datetime.now(UTC))["report.md"]
    assert all(re.match(r"[\d.]+", cell)[0] in page for cell in shown.values())
    assert "## Over all tasks" in page
    save_figure(draw_table_2(cells(runs)), tmp_path / "table_2")
    assert (tmp_path / "table_2.svg").read_text() == (PUBLISHED / "table_2.svg").read_text()


def test_bars_are_as_long_as_the_published_runs_returns(published):
    figure = draw_table_2(cells(published[1]))
    assert [panel.get_title() for panel in figure.axes] == ROWS
    with (PUBLISHED / "runs.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["stage"] == "transfer" and row["mode"] == "deterministic"]
    for panel in figure.axes:
        place = panel.get_title().lower().replace("t-rex", "trex").split(", ")
        returns = defaultdict(lambda: defaultdict(list))
        for row in rows:
            if [row["task"], row["character"]] == place:
                method = row["method"].split(",")[0].replace("-", " ").lower()
                returns[method][int(row["steps"]), row["method"]].append(float(row["normalised_return"]))
        shown = {name.lower(): both["ours"] for name, both in bars(panel).items() if "ours" in both}
        assert shown.keys() == returns.keys()
        for method, by_length in returns.items():
            steps = (max if method == "scratch" else min)(length for length, _ in by_length)
            best = max(mean(seeds) for (length, _), seeds in by_length.items() if length == steps)
            assert shown[method] == pytest.approx(best, abs=1e-6)


def test_the_papers_bars_stand_beside_ours_also_where_nothing_was_run(write_run, tmp_path):
    for seed, score in enumerate((0.2, 0.6)):
        write_run(f"scratch{seed}", seed=seed, score=score)
    (panel,) = drawn(tmp_path).axes
    found = bars(panel)
    assert found["Scratch"] == pytest.approx({"ours": 0.4, "paper": 0.927})
    assert found["MCP"] == pytest.approx({"paper": 0.976})
    (dots,) = panel.lines
    assert list(dots.get_xdata()) == [0.2, 0.6]


def test_the_share_of_successes_stands_beside_our_bar(write_run, tmp_path):
    path = write_run("carrier", task="carry", score=0.3) / "evaluation.json"
    path.write_text(path.read_text().replace('"metrics": {}', '"metrics": {"success": 0.125}'))
    (panel,) = drawn(tmp_path).axes
    (text,) = panel.texts
    assert text.get_text() == "12%"
    assert text.get_position()[0] > 0.3


def test_a_setting_that_is_no_choice_is_not_picked_by_its_return(run_writers, tmp_path):
    _, write_mcp = run_writers(tmp_path)
    for seed in range(2):
        write_mcp(f"usual{seed}", seed=seed, score=0.4, optimizer__lr=1e-4)
        write_mcp(f"weights{seed}", seed=seed, score=0.5, optimizer__lr=1e-4, exploration__name="weights")
    write_mcp("tuned", score=0.9, optimizer__lr=3e-4)
    write_mcp("kept", score=0.9, transfer__keep=["primitives", "gating"])
    (panel,) = drawn(tmp_path).axes
    assert bars(panel)["MCP"]["ours"] == pytest.approx(0.5)


def test_a_method_of_your_own_stands_below_the_papers(write_run, tmp_path):
    write_run("own", method="mine", method__title="Mine", score=0.5)
    (panel,) = drawn(tmp_path).axes
    assert panel.get_yticklabels()[-1].get_text() == "Mine"
    assert bars(panel)["Mine"] == pytest.approx({"ours": 0.5})
    assert "heading with the Biped: Mine 0.500" in describe(cells(find_runs([tmp_path])[0]))


def test_without_a_row_of_table_2_there_is_no_picture(write_run, tmp_path):
    write_run("pretraining", task="imitation", stage="pretrain", score=0.5)
    write_run("unfinished", progress=0.5)
    assert drawn(tmp_path) is None


def test_methods_are_compared_over_the_rows_that_they_share(run_writers, tmp_path):
    write_run, write_mcp = run_writers(tmp_path)
    scores = {"heading": ((0.9, 0.8), (0.85, 0.7)), "dribble": ((0.3, 0.4), (0.1, 0.2))}
    for task, (ours, others) in scores.items():
        for seed, (mine, other) in enumerate(zip(ours, others, strict=True)):
            write_mcp(f"mcp-{task}{seed}", task=task, seed=seed, score=mine)
            write_run(f"scratch-{task}{seed}", task=task, seed=seed, score=other)
    left, right = draw_over_rows(cells(find_runs([tmp_path])[0])).axes
    means = [line.get_xdata()[0] for line in left.lines if len(line.get_xdata()) == 1]
    assert dict(zip((label.get_text() for label in left.get_yticklabels()), means, strict=True)) == pytest.approx(
        {"Scratch": (0.2 + 0.7) / 2, "MCP": (0.4 + 0.8) / 2}  # the middle half of each
    )
    assert [label.get_text() for label in right.get_yticklabels()] == ["Scratch"]
    assert right.lines[1].get_xdata() == pytest.approx([(3 / 4 + 1) / 2])


def test_means_are_over_the_rows_of_all_methods_each_with_the_cell_that_stands_for_it(run_writers, tmp_path):
    write_run, write_mcp = run_writers(tmp_path)
    for seed in (1, 2):
        for task in ("heading", "carry", "dribble"):
            write_run(f"scratch-{task}{seed}", task=task, seed=seed, score=0.1 * seed, total_frames=2000)
            write_run(f"short-{task}{seed}", task=task, seed=seed, score=0.05)
        for task in ("heading", "carry"):
            write_mcp(f"mcp-{task}{seed}", task=task, seed=seed, score=0.2 * seed)
    write_mcp("unfinished", task="dribble", progress=0.5)
    write_mcp("variant", task="dribble", num_primitives=4, score=0.9)
    places, estimates = over_rows(cells(find_runs([tmp_path])[0]))
    assert places == [("heading", "biped"), ("carry", "biped")]
    assert {method: estimate.value for method, estimate in estimates.items()} == pytest.approx(
        {"scratch": 0.15, "mcp": 0.3}
    )


def test_a_short_run_of_one_method_leaves_the_others_their_runs(run_writers, tmp_path):
    write_run, write_mcp = run_writers(tmp_path)
    write_run("trial", method="finetune", score=0.1)
    for name, steps, score in (("long", 8000, 0.9), ("usual", 4000, 0.6)):
        write_mcp(name, total_frames=steps, score=score)
    (panel,) = drawn(tmp_path).axes
    ours = {name: both["ours"] for name, both in bars(panel).items() if "ours" in both}
    assert ours == pytest.approx({"Finetune": 0.1, "MCP": 0.6})


@pytest.mark.parametrize("trial", [{"preset": "smoke"}, {"preset": None, "demo__minutes": 8}], ids=["smoke", "demo"])
def test_a_trial_represents_a_method_only_where_there_is_nothing_else(run_writers, tmp_path, trial):
    _, write_mcp = run_writers(tmp_path)
    write_mcp("usual", total_frames=4000, score=0.6)
    for task in ("heading", "carry"):
        write_mcp(f"trial-{task}", task=task, total_frames=256, score=0.1, **trial)
    panels = drawn(tmp_path).axes
    assert [bars(panel)["MCP"]["ours"] for panel in panels] == pytest.approx([0.6, 0.1])


def test_methods_without_a_common_row_have_a_panel_less(run_writers, tmp_path):
    write_run, write_mcp = run_writers(tmp_path)
    for task, method in (("heading", "scratch"), ("carry", "finetune")):
        write_run(method, task=task, method=method, score=0.1)
        write_mcp(task, task=task, score=0.5)
    (panel,) = draw_over_rows(cells(find_runs([tmp_path])[0])).axes
    assert panel.get_xlabel() == "probability that MCP is ahead"


@pytest.mark.parametrize(("scores", "shown"), [((-0.2, 1.1), (-0.2, 1.1)), ((0.4, 0.6), (0.0, 1.0))], ids=str)
def test_interquartile_means_lie_within_their_panel(run_writers, tmp_path, scores, shown):
    write_run, write_mcp = run_writers(tmp_path)
    write_mcp("mcp", score=scores[0])
    write_run("scratch", score=scores[1])
    left, _ = draw_over_rows(cells(find_runs([tmp_path])[0])).axes
    low, high = left.get_xlim()
    assert low <= shown[0] <= shown[1] <= high
    assert (low, high) == pytest.approx(shown, abs=0.03)


def test_without_another_method_nothing_is_compared(run_writers, tmp_path):
    run_writers(tmp_path)[1]("mcp", score=0.5)
    assert draw_over_rows(cells(find_runs([tmp_path])[0])) is None
