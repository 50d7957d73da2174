"""Where a policy that carries or dribbles turns: its turning rate for every direction of what it should walk to.

    python benchmarks/turning.py runs/carry runs/dribble    # a minute a run, writes results/turning.csv

The newest checkpoint of each run plays deterministic episodes of ``task.evaluation``. *Away* are steps further than
0.8 m from the object, whose direction then counts; *at* are nearer steps, where the direction of the target counts.
Directions are of eight equal ranges, in degrees from the character's heading, 90 is left. ``share``: of the steps away
or at. ``turn``: mean turning rate over the next second, in rad/s, left is positive. ``approach``: mean speed in m/s at
which the character comes nearer to the object (away), and the object to the target (at).
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from report import about, table, write
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.runs import policies
from torchrl_mcp.training import checkpoint, run_folder

RESULTS = Path(__file__).resolve().parent / "results" / "turning.csv"
NEAR = 0.8
"""Metres between character and object at which the character is at the object."""
RATE = 30
"""Control steps per second."""
SECTORS = 8


def rows(path: Path, episodes: int, steps: int) -> Iterator[dict[str, Any]]:
    """Play a run's policy, and yield a row for each range of directions."""
    cfg = policies.policy_config(path)
    run = {"task": cfg.task.name, "practice": cfg.practice.name, "steps": run_folder.frames(checkpoint.find(path))}
    for row in sectors(play(path, cfg, episodes, steps)):
        yield {**run, **row, "episodes": episodes}


def sectors(recorded: dict[str, Tensor]) -> Iterator[dict[str, Any]]:
    """Yield a row for each range of directions, away from the object and at it; see :func:`play`."""
    turned = torch.remainder(recorded["heading"][RATE:] - recorded["heading"][:-RATE] + math.pi, 2 * math.pi) - math.pi
    ready = recorded["running"][RATE:] & recorded["running"][:-RATE]  # within one episode
    ways = {name: recorded[name][:-RATE] for name in ("object", "target")}
    at = ways["object"].norm(dim=-1) < NEAR
    gaps = {"object": recorded["object"].norm(dim=-1), "target": (recorded["target"] - recorded["object"]).norm(dim=-1)}
    for where, there, name in (("away", ~at & ready, "object"), ("at", at & ready, "target")):
        angles = torch.atan2(ways[name][..., 1], ways[name][..., 0])
        sector = (angles * SECTORS / (2 * math.pi)).round().long() % SECTORS
        nearer = gaps[name][:-RATE] - gaps[name][RATE:]
        for index in range(SECTORS):
            here = there & (sector == index)
            yield {
                "where": where,
                "direction": (index * 360 // SECTORS + 180) % 360 - 180,
                "share": round((here.sum() / there.sum().clamp_min(1)).item(), 3),
                "turn": round(turned[here].mean().item(), 2),
                "approach": round(nearer[here].mean().item(), 2),
            }


@torch.no_grad()
def play(path: Path, cfg: Any, episodes: int, steps: int) -> dict[str, Tensor]:
    """Play the first episode of each simulation, and return what it was like in every step, ``(T, N, ...)``."""
    evaluation: Any = OmegaConf.to_container(cfg.evaluation, resolve=True)
    _, agent, env = policies.restore(path, num_envs=episodes, seed=evaluation["seed"], **evaluation["environment"])
    task = getattr(env, "base_env", env)  # below the transforms, if there are any
    positions = [task.goal_layout[name] for name in task.goal_layout if name.endswith(".position")]
    running, state, recorded = torch.ones(episodes, dtype=torch.bool), env.reset(), []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(steps):
            goal = state["goal"]
            seen = {"target": goal[:, positions[0]][:, :2], "object": goal[:, positions[-1]][:, :2]}
            recorded.append({"heading": task.heading(slice(None)).clone(), "running": running.clone(), **seen})
            taken, state = env.step_and_maybe_reset(agent.actor.policy(state))
            running &= ~taken["next", "done"].squeeze(-1)
    return {name: torch.stack([step[name] for step in recorded]) for name in recorded[0]}


def main() -> None:
    """Play, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders or checkpoint files")
    parser.add_argument("--episodes", type=int, default=64, help="default 64")
    parser.add_argument("--steps", type=int, default=600, help="of each episode (default 600)")
    parser.add_argument("--output", type=Path, default=RESULTS, help="CSV file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    measured = [row for run in arguments.runs for row in rows(run, arguments.episodes, arguments.steps)]
    print(table(measured))
    write(arguments.output, [row | about() for row in measured])


if __name__ == "__main__":
    main()
