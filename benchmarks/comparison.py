"""The methods on a task at equal budgets: results of a benchmark's runs as a table and learning curves.

    torchrl-mcp-train benchmark=table2 task=heading character=biped preset=comparison benchmark.pretrain_seed=0 seed=0,1
    python benchmarks/comparison.py runs --task heading --character biped
    python benchmarks/comparison.py runs --task imitation --character biped --stage pretrain

It writes a row for every complete run and mode to ``results/TASK_CHARACTER_methods.csv``, with everything needed to
reproduce the run, and beside it the learning curves of runs with the most common number of pre-training steps.
``torchrl-mcp-report runs`` writes a page with more results.
"""

import argparse
import csv
import shlex
from collections import Counter
from pathlib import Path
from typing import Any

from torchrl_mcp.analysis.curves import draw_curves, learning_curves, write_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.report.comparison import Cell, cells
from torchrl_mcp.report.results import MODES, Run, find_runs
from torchrl_mcp.runs.tables import text_table

RESULTS = Path(__file__).resolve().parent / "results"


def main() -> None:
    """Read the runs and write their results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path, help="the benchmark's run_root")
    parser.add_argument("--task", default="heading")
    parser.add_argument("--character", default="biped")
    parser.add_argument("--stage", default="transfer", choices=["pretrain", "transfer"])
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder to write to")
    arguments = parser.parse_args()
    runs, _ = find_runs([arguments.runs])
    place = arguments.task, arguments.character
    found = [cell for cell in cells(runs) if cell.place == place and cell.stage == arguments.stage and cell.complete]
    if not found:
        parser.error(f"{arguments.runs} holds no complete run of {' '.join(place)}, {arguments.stage}")
    usual = Counter(map(budget, found)).most_common(1)[0][0]
    titles = [title(cell, usual) for cell in found]
    steps = {run.path.resolve(): run.frames for run in runs}
    rows = [
        row(cell, name, run, mode, steps)
        for cell, name in zip(found, titles, strict=True)
        for run in cell.complete
        for mode in MODES
    ]
    for facts in rows:
        facts["command"] = facts["command"].replace(str(arguments.runs.resolve()), "runs")
    stem = arguments.output / f"{arguments.task}_{arguments.character}_methods"
    with stem.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    drawn = [cell for cell in found if budget(cell) == usual]
    curves = learning_curves({title(cell, usual): [run.path for run in cell.complete] for cell in drawn})
    write_curves(curves, stem.with_name(f"{stem.name}_curves.csv"))
    save_figure(draw_curves(curves), stem.with_name(f"{stem.name}_curves"))
    print(text_table([line(cell, name) for cell, name in zip(found, titles, strict=True)], markdown=True))


def row(cell: Cell, name: str, run: Run, mode: str, steps: dict[Path, int]) -> dict[str, Any]:
    """Return the facts about a run and its results in a mode."""
    numbers, before = run.evaluation[mode], run.settings.get("pretrained")
    machine, command = run.provenance.get("machine", {}), run.provenance.get("command", [])
    return {
        "method": name,
        "seed": run.seed,
        "pretraining_steps": steps.get(Path(before).resolve(), "") if before else 0,
        "steps": run.frames,
        "mode": mode,
        **{key: numbers[key] for key in ("normalised_return", "interval", "return", "length", "terminated")},
        **{key: value for key, value in numbers["metrics"].items() if not key.startswith("reward_")},
        "episodes": numbers["episodes"],
        "paper": paper(cell),
        "seconds": round(run.seconds),
        "preset": run.preset,
        "commit": run.commit,
        **{key: machine.get(key, "") for key in ("processor", "cores", "torch", "mujoco")},
        "command": shlex.join(command),
    }


def line(cell: Cell, name: str) -> dict[str, Any]:
    """Return a row of the printed table: means and standard deviations over seeds."""
    scores = {}
    for mode in MODES:
        spread = f" +- {cell.deviation(mode):.3f}" if len(cell.complete) > 1 else ""
        scores[mode] = f"{sum(cell.returns(mode)) / len(cell.complete):.3f}{spread}"
    fallen = [run.evaluation["deterministic"]["terminated"] for run in cell.complete]
    return {
        "method": name,
        "seeds": len(cell.complete),
        "deterministic": scores["deterministic"],
        "fallen": f"{sum(fallen) / len(fallen):.0%}",
        "stochastic": scores["stochastic"],
        "paper": paper(cell),
    }


def title(cell: Cell, usual: int | None) -> str:
    """Return the name of a method, with its pre-training if that is not the most common one."""
    if cell.choices["pretrained"]:
        return f"{cell.title}, built in"
    steps = budget(cell)
    return cell.title + (f", {steps / 1e6:g} M" if steps and steps != usual else "")


def budget(cell: Cell) -> int | None:
    """Return the steps of pre-training, if the preset has them."""
    return cell.complete[0].settings.get("budget.pretrain")


def paper(cell: Cell) -> str:
    """Return the paper's result, if it has one."""
    return f"{cell.reported.mean:.3f} +- {cell.reported.std:.3f}" if cell.reported else ""


if __name__ == "__main__":
    main()
