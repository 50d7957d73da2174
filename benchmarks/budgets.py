r"""Evaluates checkpoints of the biped's dribbling, to show how the lead of one method depends on the number of steps.

    torchrl-mcp-train benchmark=table2 preset=comparison autocast=false task=dribble character=biped \
        method=mcp,latent_space seed=0,1,2,3,4,5,6,7 checkpoint_interval=62 keep_checkpoints=100 run_root=runs/budgets
    python benchmarks/budgets.py runs/budgets

For each transfer to this task in the folder and each of the numbers of steps in ``BUDGETS``, the script evaluates the
first checkpoint that has at least as many steps, with 128 deterministic and 128 exploring episodes. A checkpoint with
more than 5 % too many steps is not evaluated. ``results/budgets.csv`` has a row for each mode of each evaluation.
Checkpoints that already have rows are not evaluated again, so that the script can be called again and again while runs
train; delete the rows of runs that were repeated. The picture ``results/budgets.png`` shows the share of successful
episodes, averaged over seeds, with 95 % bootstrap intervals. If there are runs of two methods, the script prints the
difference between their success rates after each number of steps, with an interval that resamples seeds. Every seed has
a pre-training of its own.
"""

import argparse
import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from report import about, append, table

from torchrl_mcp.analysis.figures import COLOURS, INK, bare, new_figure, save_figure
from torchrl_mcp.evaluation import statistics
from torchrl_mcp.report.results import Run, find_runs
from torchrl_mcp.runs import policies
from torchrl_mcp.training.run_folder import MODES, find_all, frames

RESULTS = Path(__file__).resolve().parent / "results" / "budgets.csv"

BUDGETS = (1_000_000, 3_000_000, 10_000_000, 30_000_000)
"""Numbers of steps after which a run is evaluated."""

TOLERANCE = 0.05
"""Largest excess of a checkpoint's steps over its budget, as a share of the budget."""

SEED = 12345
"""Seed of the evaluations, that of the table."""

PLACE = ("dribble", "biped")
"""Task and character of the runs."""


def evaluate(runs: Sequence[Run], rows: list[dict[str, Any]], *, episodes: int) -> Iterator[dict[str, Any]]:
    """Yield a row for every checkpoint to be evaluated that has no row yet."""
    present = {(row["method"], int(row["seed"]), int(row["budget"]), row["mode"]) for row in rows}
    for run in runs:
        for budget, checkpoint in checkpoints_of(run.path).items():
            missing = [mode for mode in MODES if (run.method, run.seed, budget, mode) not in present]
            evaluation = policies.evaluation(checkpoint, episodes=episodes, seed=SEED) if missing else {}
            for mode in missing:
                numbers = evaluation[mode]
                yield {
                    "task": run.place[0],
                    "character": run.place[1],
                    "method": run.method,
                    "seed": run.seed,
                    "budget": budget,
                    "steps": frames(checkpoint),
                    "mode": mode,
                    "success": numbers["metrics"]["success"],
                    "skill": numbers["reach"]["skill"],
                    **{key: numbers[key] for key in ("normalised_return", "success_return", "terminated", "episodes")},
                    "run_commit": run.commit,
                    **about(),
                }


def checkpoints_of(folder: Path) -> dict[int, Path]:
    """Return the checkpoint of a run for each budget: the first one with enough steps and not with far too many."""
    checkpoints = find_all(folder)[::-1]
    first = {budget: next((c for c in checkpoints if frames(c) >= budget), None) for budget in BUDGETS}
    return {budget: c for budget, c in first.items() if c and frames(c) <= (1 + TOLERANCE) * budget}


def successes(rows: Sequence[dict[str, Any]]) -> dict[str, dict[int, list[float]]]:
    """Return the deterministic success rates of all seeds, by method and budget."""
    rates: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        if row["mode"] == "deterministic":
            rates.setdefault(row["method"], {}).setdefault(int(row["budget"]), []).append(float(row["success"]))
    return rates


def differences(rates: dict[str, dict[int, list[float]]]) -> Iterator[dict[str, Any]]:
    """Yield a row for each budget that both of two methods reached: mean success rates and their difference."""
    for budget in sorted(set.intersection(*(set(reached) for reached in rates.values()))):
        samples = {method: of_method[budget] for method, of_method in rates.items()}
        estimate = statistics.difference(*samples.values())
        interval = "" if math.isnan(estimate.low) else f" [{estimate.low:+.0%}, {estimate.high:+.0%}]"
        yield {
            "steps": f"{budget:,}",
            **{method: f"{statistics.mean(sample).value:.0%}" for method, sample in samples.items()},
            "seeds": ", ".join(str(len(sample)) for sample in samples.values()),
            "difference": f"{estimate.value:+.0%}{interval}",
        }


def draw(rates: dict[str, dict[int, list[float]]]) -> Figure:
    """Return a figure of the success rates by steps, with the intervals of the means and a dot for every seed."""
    figure = new_figure(5.2, 3.2)
    axes = figure.add_subplot()
    for colour, (method, by_budget) in zip(COLOURS, rates.items(), strict=False):
        budgets = sorted(by_budget)
        means = [statistics.mean(by_budget[budget]) for budget in budgets]
        axes.plot(budgets, [mean.value for mean in means], color=colour, label=method)
        axes.fill_between(budgets, [m.low for m in means], [m.high for m in means], color=colour, alpha=0.2, lw=0)
        for budget in budgets:
            axes.plot([budget] * len(by_budget[budget]), by_budget[budget], ".", color=colour, alpha=0.5)
    axes.set(xscale="log", xlabel="steps of transfer", ylabel="share of successful episodes", ylim=(0, 1))
    axes.legend(frameon=False, labelcolor=INK)
    bare(axes)
    return figure


def main() -> None:
    """Evaluate, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="?", help="run_root of the runs; default: draw the rows again")
    parser.add_argument("--episodes", type=int, default=128, help="episodes per evaluation (default %(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS, help=f"CSV file (default {RESULTS.name})")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = list(csv.DictReader(arguments.output.open())) if arguments.output.exists() else []
    if arguments.runs:
        runs = [run for run in find_runs([arguments.runs])[0] if run.stage == "transfer" and run.place == PLACE]
        for row in evaluate(runs, list(rows), episodes=arguments.episodes):
            rows.append(row)
            append(arguments.output, row)
    rates = successes(rows)
    if len(rates) == 2:
        print(table(list(differences(rates))))
    save_figure(draw(rates), arguments.output.with_suffix(""))


if __name__ == "__main__":
    main()
