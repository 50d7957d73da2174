"""Collection in workers: returns and speed, compared with one process.

    python benchmarks/collection.py            # ten minutes, writes results/collection.csv
    python benchmarks/collection.py --quick    # tests that it runs, writes nothing unless given --output

An ant learns to run in held-out directions from scratch with ``preset=fast``, on the same cores: in one process with a
thread per core, and with a worker per core in processes and in Ray. A speed is the median over iterations; a return is
the mean over the last quarter of the iterations and over seeds.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory

from report import about, table, write

from torchrl_mcp.analysis import read_metrics

RESULTS = Path(__file__).resolve().parent / "results" / "collection.csv"
CORES = os.cpu_count() or 1
COLLECTORS = {
    "local": [f"num_threads={CORES}"],
    "processes": [f"collector.num_workers={CORES}"],
    "ray": [f"collector.num_workers={CORES}"],
}
COMMON = ["method=scratch", "task=holdout", "stage=transfer", "width=1.0", "learned_std=false"]
QUIET = ["logger=none", "progress_bar=false", "evaluation.episodes=0"]


def main() -> None:
    """Train with every collector, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=204_800, help="of each run")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--quick", action="store_true", help="few steps, one seed")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    steps, seeds = (12_288, [0]) if arguments.quick else (arguments.steps, arguments.seeds)
    runs = {(name, seed): train(name, seed, steps) for seed in seeds for name in COLLECTORS}
    rows = []
    for name in COLLECTORS:
        speeds, returns = zip(*(runs[name, seed] for seed in seeds), strict=True)
        learnt = {"mean": mean(returns), "lowest": min(returns), "highest": max(returns)}
        facts = {"collector": name, "steps": steps, "seeds": len(seeds), "steps_per_second": round(median(speeds))}
        rows.append(facts | {f"{key}_return": round(value, 3) for key, value in learnt.items()})
    print(table(rows))
    if path := arguments.output or (None if arguments.quick else RESULTS):
        write(path, [row | about() for row in rows])


def train(collector: str, seed: int, steps: int) -> tuple[float, float]:
    """Train in separate processes; return steps per second and the final normalised return."""
    with TemporaryDirectory() as folder:
        settings = [*COMMON, *QUIET, *COLLECTORS[collector], f"collector={collector}", f"seed={seed}"]
        arguments = [*settings, f"training.total_frames={steps}", f"run_dir={folder}/run"]
        environment = {**os.environ, "OMP_NUM_THREADS": str(CORES), "RAY_USAGE_STATS_ENABLED": "0"}
        subprocess.run([sys.executable, "-m", "torchrl_mcp.cli.train", *arguments], check=True, env=environment)
        rows = list(read_metrics(Path(folder) / "run"))
    ended = [row for row in rows[-len(rows) // 4 :] if row["episode/count"]]
    late = [row["episode/normalised_return"] for row in ended]
    return median(row["time/steps_per_second"] for row in rows), mean(late) if late else float("nan")


if __name__ == "__main__":
    main()
