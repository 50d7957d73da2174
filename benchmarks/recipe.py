r"""Short runs of one method that differ in one setting each: a table of what they learned in the same steps.

    torchrl-mcp-train --multirun task=imitation character=biped stage=pretrain method=mcp,finetune,moe seed=0,1 \
        training.total_frames=1_007_616 action_std=0.05,0.1 run_root=runs/recipe
    python benchmarks/recipe.py runs/recipe      # writes results/recipe.csv

*Training* is the normalised return of the episodes that ended in the last tenth of the steps, of the exploring policy.
"""

import argparse
import shlex
from pathlib import Path
from typing import Any

from report import write

from torchrl_mcp.report.results import Run, find_runs
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import NORMALISED_RETURN, read_metrics

RESULTS = Path(__file__).resolve().parent / "results" / "recipe.csv"
ELSEWHERE = (
    *(
        "method=",
        "task=",
        "character=",
        "stage=",
        "seed=",
        "preset=",
        "training.total_frames=",
        "autocast=",
        "run_dir=",
    ),
    *("run_root=", "checkpoint_interval=", "keep_checkpoints=", "logger=", "torch_threads=", "num_threads="),
    *("progress_bar=", "evaluation.", "pretrained="),
)
"""Beginnings of arguments that have a column of their own, or only say where and how a run was made."""


def main() -> None:
    """Read the runs, print and write their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the run folders")
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    rows = [row(run) for run in find_runs([arguments.runs])[0] if run.frames]
    rows.sort(key=lambda row: (row["task"], row["method"], row["settings"], row["seed"]))
    write(arguments.output, rows)
    print(text_table([{name: row[name] for name in list(row)[:12]} for row in rows]))


def row(run: Run) -> dict[str, Any]:
    """Return the settings of a run with what it learned; a run that diverged has no evaluation."""
    metrics = read_metrics(run.path)
    last = [row for row in metrics if row["frames"] > 0.9 * run.frames and row["episode/count"]]
    episodes = sum(row["episode/count"] for row in last)
    command = run.provenance.get("command", [])[1:]
    return {
        "task": run.place[0],
        "method": run.method,
        "settings": shlex.join(word for word in command if not word.startswith(ELSEWHERE)),
        "seed": run.seed,
        "steps": run.frames,
        "training": round(sum(row["episode/count"] * row[NORMALISED_RETURN] for row in last) / episodes, 4),
        **{mode: evaluated(run, mode, "normalised_return") for mode in ("deterministic", "stochastic")},
        "fallen": evaluated(run, "deterministic", "terminated"),
        "std": round(last[-1].get("policy/std", float("nan")), 4),
        "dead": " ".join(f"{name[11:]} {value:.0%}" for name, value in last[-1].items() if name.startswith("dead")),
        "steps_per_second": round(run.frames / run.seconds),
        "commit": run.commit,
        "processor": run.provenance.get("machine", {}).get("processor", ""),
    }


def evaluated(run: Run, mode: str, name: str) -> float | str:
    """Return a number of a run's evaluation, empty without one."""
    return round(run.evaluation[mode][name], 4) if run.evaluation else ""


if __name__ == "__main__":
    main()
