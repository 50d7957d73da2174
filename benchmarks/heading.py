"""The heading task learned from scratch: learning curves, returns beside the paper's, and films.

    python benchmarks/heading.py                      # trains missing runs: an hour or two per character on a core
    python benchmarks/heading.py --report             # trains nothing

Every character learns with ``method=scratch task=heading preset=fast width=1.0 learned_std=false
character.action_std=0.15`` for the steps in ``CHARACTERS``. Run folders are in ``--output``; stopped runs are resumed.
The report plays one episode of 20 s in each of ``--episodes`` environments and writes ``results/heading.csv``,
``heading_curves.csv``, ``.png`` and ``.svg``, and a film of each character, ``heading_<character>.gif``
(MUJOCO_GL=egl or osmesa without a display).
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from report import about, table, write

from torchrl_mcp.analysis import draw_curves, learning_curves, read_metrics, write_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.runs import policies
from torchrl_mcp.training.run_folder import CONFIG
from torchrl_mcp.viewer.film import save_film

RESULTS = Path(__file__).resolve().parent / "results"
CHARACTERS = {"biped": 4_000_000, "humanoid": 3_000_000, "trex": 1_000_000}
PAPER = {"biped": "0.927 +- 0.032", "humanoid": "0.965 +- 0.010", "trex": "0.840 +- 0.003"}
COMMON = [
    *("method=scratch", "task=heading", "preset=fast", "width=1.0", "learned_std=false"),
    *("logger=none", "torch_threads=1", "num_threads=1"),
]
EVALUATION_SEED = 12345


def main() -> None:
    """Train missing runs, evaluate, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--output", type=Path, default=Path("runs/heading"), help="folder of the run folders")
    parser.add_argument("--characters", nargs="+", default=list(CHARACTERS), choices=CHARACTERS)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at a time, one core each")
    parser.add_argument("--report", action="store_true", help="train nothing: report the runs that have ended")
    parser.add_argument("--episodes", type=int, default=128, help="of each evaluation")
    arguments = parser.parse_args()
    runs = {character: arguments.output / f"heading-{character}" for character in arguments.characters}
    if not arguments.report:
        with ThreadPoolExecutor(arguments.jobs) as pool:
            list(pool.map(train, runs.values(), runs))
    report({name: run for name, run in runs.items() if has_ended(run, CHARACTERS[name])}, arguments.episodes)


def train(run: Path, character: str) -> None:
    """Train a character in a separate process, or resume its run."""
    settings = [
        f"character={character}",
        "character.action_std=0.15",
        f"training.total_frames={CHARACTERS[character]}",
        "progress_bar=false",
    ]
    begun = (run / CONFIG).exists()
    arguments = [f"resume={run}"] if begun else [*COMMON, *settings, f"run_dir={run}"]
    command = [sys.executable, "-m", "torchrl_mcp.cli.train", *arguments]
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def has_ended(run: Path, steps: int) -> bool:
    """Return whether a run has taken all its steps."""
    rows = read_metrics(run)
    return bool(rows) and rows[-1]["frames"] >= steps


def report(runs: dict[str, Path], episodes: int) -> None:
    """Write table, curves and films of finished runs to ``benchmarks/results``."""
    rows = [row for character, run in runs.items() for row in evaluate(character, run, episodes)]
    write(RESULTS / "heading.csv", rows)
    curves = learning_curves({character: [run] for character, run in runs.items()})
    write_curves(curves, RESULTS / "heading_curves.csv")
    save_figure(draw_curves(curves), RESULTS / "heading_curves")
    for character, run in runs.items():
        _, agent, env = policies.restore(run, num_envs=1, seed=EVALUATION_SEED)
        save_film(agent.actor.policy, env, RESULTS / f"heading_{character}.gif")
    shown = ("character", "mode", "normalised_return", "normalised_return_std", "terminated", "paper")
    print(table([{key: row[key] for key in shown} for row in rows]))


def evaluate(character: str, run: Path, episodes: int) -> Iterator[dict]:
    """Yield the results of a run, deterministic and stochastic."""
    last = read_metrics(run)[-1]
    facts = {"character": character, "method": "scratch", "seed": 0, "preset": "fast", "paper": PAPER[character]}
    cost = {"frames": int(last["frames"]), "training_seconds": round(last["seconds"])}
    for mode, numbers in policies.evaluate_run(run, episodes=episodes, seed=EVALUATION_SEED).items():
        del numbers["metrics"], numbers["diagnostics"]
        yield facts | cost | {"mode": mode} | numbers | about()


if __name__ == "__main__":
    main()
