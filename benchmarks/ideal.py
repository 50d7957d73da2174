"""Computes bounds on the return of each task: the returns of standing still and of an ideal player.

    python benchmarks/ideal.py    # a minute, writes results/ideal.csv

The ideal player has no body: object and character move straight to their targets at the task's speed, and wait there
(:mod:`torchrl_mcp.envs.ideal`). Returns are normalised means over 1,000 episodes, which are drawn as in evaluations.
The reward of holdout has no upper bound; its ideal is the return at which Gymnasium counts the task as solved.
``--quick`` takes seconds, draws 20 episodes and writes nothing without ``--output``.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from report import about, table, write

from torchrl_mcp.report.paper import TABLE_2
from torchrl_mcp.runs import build
from torchrl_mcp.runs.configuration import compose_run

RESULTS = Path(__file__).resolve().parent / "results" / "ideal.csv"
VARIANTS: list[tuple[str, str, dict[str, Any]]] = [
    ("heading", "biped", {}),
    ("carry", "biped", {}),
    ("carry", "biped", {"success_reward": True}),
    ("dribble", "biped", {}),
    ("dribble", "biped", {"success_reward": True}),
    ("dribble", "biped", {"max_episode_steps": 3000}),
    ("dribble", "humanoid", {}),
    ("dribble", "trex", {}),
    ("holdout", "ant", {}),
]
"""Tasks as they are evaluated, and variants with another reward or length."""


def rows(episodes: int) -> Iterator[dict[str, Any]]:
    """Draw episodes of each variant, and yield the bounds on their returns."""
    for task, character, changes in VARIANTS:
        stage = "pretrain" if task == "holdout" else "transfer"
        cfg = compose_run(f"task={task}", f"character={character}", f"stage={stage}")
        evaluated: Any = OmegaConf.to_container(cfg.evaluation.environment, resolve=True)
        env = build.make_env(cfg, num_envs=episodes, seed=12345, **evaluated | changes)
        env.reset()
        reach = env.reach()
        paper = TABLE_2.get((task, character, "mcp"))
        yield {
            "task": task,
            "character": character,
            "changes": " ".join(f"{key}={value}" for key, value in changes.items()) or "-",
            "standing": round(env.normalised_return(reach.standing).mean().item(), 3),
            "ideal": round(env.normalised_return(reach.ideal).mean().item(), 3),
            "paper_mcp": paper.mean if paper else "-",
        }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 episodes")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    arguments = parser.parse_args()
    episodes = 20 if arguments.quick else 1000
    measured = list(rows(episodes))
    print(table(measured))
    if output := arguments.output or (None if arguments.quick else RESULTS):
        write(output, [{**row, "episodes": episodes, **about()} for row in measured])


if __name__ == "__main__":
    main()
