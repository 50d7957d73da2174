r"""Learning curves of carrying and dribbling for every kind of training episodes (``practice``).

    torchrl-mcp-train --multirun method=mcp task=carry,dribble character=biped stage=transfer pretrained=builtin \
        practice=printed,beginnings,ranges,shaping,emphasis exploration=correlated_weights gating.network.width=0.5 \
        critic.width=0.5 optimizer.critic.lr=3e-4 training.total_frames=409_600 checkpoint_interval=50 \
        keep_checkpoints=9 evaluation.episodes=0 run_root=runs/practice    # four minutes a run on a core
    python benchmarks/practice.py runs/practice    # half a minute a checkpoint; writes results/practice.csv and figures

Every kept checkpoint of a run plays deterministic episodes of ``task.evaluation``, the same for all runs.
``practice_TASK.png`` and ``practice_TASK_success.png`` have a line for each practice, with the range over its seeds.
"""

import argparse
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import OmegaConf
from report import about, earned, table, write

from torchrl_mcp.analysis import draw_curves
from torchrl_mcp.analysis.curves import Curve
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.runs import policies
from torchrl_mcp.training import run_folder

RESULTS = Path(__file__).resolve().parent / "results" / "practice"
SETTINGS = ("practice", "exploration", "logits_std", "gamma")
"""Settings of training, which runs of a curve have in common."""


def main() -> None:
    """Evaluate the checkpoints, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="folder of the run folders")
    parser.add_argument("--episodes", type=int, default=64, help="of each evaluation (default 64)")
    parser.add_argument("--output", type=Path, default=RESULTS, help="path of the results without suffix")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for config in sorted(arguments.runs.rglob(run_folder.CONFIG)):
        for path in reversed(run_folder.find_all(config.parent)):
            if run_folder.frames(path):
                rows.append(row(path, arguments.episodes) | about())
                print(table([{key: rows[-1][key] for key in list(rows[-1])[:10]}]), flush=True)
    if not rows:
        parser.error(f"{arguments.runs} holds no run with a checkpoint")
    rows.sort(key=lambda row: (row["task"], *map(str, training(row)), row["seed"], row["steps"]))
    write(arguments.output.with_suffix(".csv"), rows)
    for task, of_task in groupby(rows, lambda row: row["task"]):
        found = list(of_task)
        for name, ending in (("normalised_return", ""), ("success", "_success")):
            figure = draw_curves(list(curves(found, name)), ylabel=name.replace("_", " "))
            save_figure(figure, arguments.output.with_name(f"{arguments.output.name}_{task}{ending}"))


def row(path: Path, episodes: int) -> dict[str, Any]:
    """Return the results of a checkpoint's policy in the episodes of its evaluation."""
    cfg = policies.policy_config(path)
    evaluation: Any = OmegaConf.to_container(cfg.evaluation, resolve=True)
    seed, settings = evaluation["seed"], evaluation["environment"]
    _, agent, env = policies.restore(path, num_envs=episodes, seed=seed, **settings)
    return {
        "task": cfg.task.name,
        "practice": cfg.practice.name,
        "exploration": cfg.exploration.name,
        "logits_std": cfg.exploration.actor.get("logits_std", ""),
        "gamma": cfg.stage.gamma,
        "seed": cfg.seed,
        "steps": run_folder.frames(path),
        **earned(agent.actor.policy, env),
        "trained_at": trained_at(path),
    }


def trained_at(path: Path) -> str:
    """Return the commit at the start of a checkpoint's run."""
    return run_folder.read_json(path.parents[1] / run_folder.PROVENANCE).get("commit") or ""


def training(row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the settings of a row's training."""
    return tuple(row[name] for name in SETTINGS)


def told_apart(name: str, value: Any) -> str:
    """Return a setting in words: numbers have their name before them."""
    return (value if name == "exploration" else f"{name} {value}").replace("_", " ")


def labels(kinds: list[tuple[Any, ...]]) -> list[str]:
    """Return labels of kinds of training: the practice, and as many other settings as tell them apart."""
    for last in range(1, len(SETTINGS) + 1):
        told = [[told_apart(*pair) for pair in zip(SETTINGS[1:last], kind[1:last], strict=True)] for kind in kinds]
        texts = [", ".join([kind[0], *of_kind]) for kind, of_kind in zip(kinds, told, strict=True)]
        if len(set(texts)) == len(texts):
            break
    return texts


def curves(rows: list[dict[str, Any]], name: str) -> Iterator[Curve]:
    """Yield a curve of a number over the seeds of each kind of training, at the steps that all of them have."""
    groups = [(kind, list(alike)) for kind, alike in groupby(rows, training)]
    for label, (_, alike) in zip(labels([kind for kind, _ in groups]), groups, strict=True):
        seeds: dict[int, dict[int, float]] = {}
        for row in alike:
            seeds.setdefault(row["seed"], {})[row["steps"]] = row[name]
        steps = sorted(set.intersection(*(set(found) for found in seeds.values())))
        values = np.array([[found[step] for step in steps] for found in seeds.values()])
        yield Curve(label, np.array(steps, float), values.mean(0), values.min(0), values.max(0), len(seeds))


if __name__ == "__main__":
    main()
